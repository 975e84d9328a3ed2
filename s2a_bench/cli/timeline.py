"""`s2a-bench timeline`: what each policy makes of the tokens of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from s2a_bench.cli.options import listed, numbers, whole_numbers
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.cli.timeline_live import given_live, live_config, refuse_with_live, refuse_without_live
from s2a_bench.errors import S2AError, UsageError
from s2a_bench.inference import ENGINES
from s2a_bench.policy import POLICIES
from s2a_bench.runtime import ROBOTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.cli.timeline_view import TimelineView

PROFILES = "rtx-4080,jetson-agx-orin,jetson-orin-nano"
REAL_TIME_PROFILE = "jetson-agx-orin"
LENGTHS = "6,4,2,1"


def timeline(
    policy: Annotated[
        str,
        typer.Option(
            help=f"{', '.join(POLICIES)}, with parameters as in NAME?parameter=value&other=value; several with commas"
        ),
    ] = "naive,wait-then-act,stream-to-act",
    profile: Annotated[
        str,
        typer.Option(
            help=f"boards: names of 'profile list', or paths [default: {PROFILES}; --real-time: {REAL_TIME_PROFILE}; "
            "none with --rate]; with --live what --engine replay plays"
        ),
    ] = "",
    rate: Annotated[str, typer.Option(help="boards of which only the tokens/s are known; several with commas")] = "",
    prompt_time: Annotated[
        float | None, typer.Option(help="seconds before decoding, c [default: the profile's; with --rate 0]")
    ] = None,
    tokens_per_skill: Annotated[
        str, typer.Option(help=f"L, the delimiter included; several with commas [default: {LENGTHS}; --live: 6]")
    ] = "",
    n_skills: Annotated[str, typer.Option(help="N, skills a plan; several with commas")] = "8",
    t_nom: Annotated[
        str, typer.Option(help="seconds a skill takes; several with commas [default: 1; --live: the skill set's own]")
    ] = "",
    t_min: Annotated[float, typer.Option(help="least duration of a skill, as a factor of T_nom")] = 0.8,
    t_max: Annotated[float, typer.Option(help="longest duration of a skill, as a factor of T_nom")] = 1.5,
    t_nom_cv: Annotated[float, typer.Option(help="how much T_nom differs from skill to skill: sd / mean")] = 0.0,
    jitter: Annotated[
        str,
        typer.Option(
            help="none (tokens come evenly, as in the paper), profile (as the profile says), or a family of gaps, as "
            "lognormal:cv=0.2"
        ),
    ] = "none",
    plans: Annotated[int | None, typer.Option(help="plans a cell [default: 1; with jitter 1000]")] = None,
    epsilon: Annotated[float, typer.Option(help="share of plans that may stall: lambda is calibrated for it")] = 0.01,
    calibration_plans: Annotated[int, typer.Option(help="other plans that prior and lambda are learned from")] = 400,
    calibrate: Annotated[
        Path | None,
        typer.Option(help="run folder of latency or throughput: learn prior and lambda from its answers instead"),
    ] = None,
    gap_bound: Annotated[
        float | None, typer.Option(help="s2a-robust: the longest gap between skills, over L/R [default: unbounded]")
    ] = None,
    seed: Annotated[int, typer.Option(help="seed of everything that is drawn")] = 0,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="play the boards' tokens on the clock and execute while you watch")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="execute what a model really answers, as it arrives")] = False,
    transport: Annotated[
        str | None, typer.Option(help="--live: ros, ros/action, http, http/VARIANT, loopback [default: ros]")
    ] = None,
    pace: Annotated[
        float | None, typer.Option(help="--live: hold the answer back to so many tokens/s [default: the model's own]")
    ] = None,
    skills: Annotated[
        str | None, typer.Option(help="--live: household, driving, or a TOML file [default: household]")
    ] = None,
    task: Annotated[str | None, typer.Option(help="--live: what the robot should do, text or @FILE")] = None,
    robot: Annotated[
        str | None, typer.Option(help=f"--live: {', '.join(ROBOTS)}; timed only waits [default: timed]")
    ] = None,
    engine: Annotated[str | None, typer.Option(help=f"--live: {', '.join(ENGINES)} [default: llama]")] = None,
    model: Annotated[str | None, typer.Option(help="--live: GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[str | None, typer.Option(help="--live: GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int | None, typer.Option(min=0, help="--live: CPU threads of the model [default: all]")] = None,
    gpu_layers: Annotated[int | None, typer.Option(min=-1, help="--live: layers on the GPU; -1: all")] = None,
    source: Annotated[str | None, typer.Option(help="--live: the camera [default: synthetic]")] = None,
    size: Annotated[str | None, typer.Option(help="--live: WIDTHxHEIGHT of the frames [default: 640x480]")] = None,
    url: Annotated[str | None, typer.Option(help="--live: an HTTP server that runs already (a black box)")] = None,
    dialect: Annotated[str | None, typer.Option(help="--live: what --url speaks [default: ask]")] = None,
    no_grammar: Annotated[bool, typer.Option("--no-grammar", help="--live: let the model write what it likes")] = False,
    warmup: Annotated[
        int | None, typer.Option(min=0, help="--live: answers before, which policies learn the rate from [default: 1]")
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(help="--live: seconds without a token after which the robot holds [default: 60]")
    ] = None,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    per_skill: Annotated[bool, typer.Option("--per-skill", help="also print every skill of the shown plans")] = False,
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live."""
    from s2a_bench.experiments.timeline.config import TimelineConfig

    for_live = {"transport": transport, "pace": pace, "skills": skills, "task": task, "robot": robot, "engine": engine}
    for_live |= {"model": model, "mmproj": mmproj, "threads": threads, "gpu-layers": gpu_layers, "source": source}
    for_live |= {"size": size, "url": url, "dialect": dialect, "no-grammar": no_grammar, "warmup": warmup}
    given = given_live({**for_live, "timeout": timeout})
    if live:
        if real_time:
            raise UsageError("--live and --real-time are two things: a model answers, or a profile is played")
        modelled = {"rate": (rate, ""), "prompt-time": (prompt_time, None), "t-nom-cv": (t_nom_cv, 0.0)}
        modelled |= {"jitter": (jitter, "none"), "epsilon": (epsilon, 0.01), "gap-bound": (gap_bound, None)}
        refuse_with_live({**modelled, "calibration-plans": (calibration_plans, 400), "calibrate": (calibrate, None)})
        asked = live_config(
            given,
            policy=policy,
            profile=profile,
            tokens_per_skill=tokens_per_skill,
            n_skills=n_skills,
            t_nom=t_nom,
            t_min=t_min,
            t_max=t_max,
            plans=plans,
            seed=seed,
        )
        asked.check()
        from s2a_bench.experiments.timeline.live.run import run_live

        execute(lambda view: run_live(asked, output, view), as_json=json_, per_skill=per_skill, data_only=data_only)
        return
    refuse_without_live(given)
    default_profiles = REAL_TIME_PROFILE if real_time else PROFILES
    config = TimelineConfig(
        policies=listed(policy),
        profiles=listed(profile or ("" if rate else default_profiles)),
        rates=numbers("--rate", rate),
        prompt_s=prompt_time,
        tokens_per_skill=whole_numbers("--tokens-per-skill", tokens_per_skill or LENGTHS),
        n_skills=whole_numbers("--n-skills", n_skills),
        t_nom_s=numbers("--t-nom", t_nom or "1"),
        t_min=t_min,
        t_max=t_max,
        t_nom_cv=t_nom_cv,
        jitter=jitter,
        plans=plans,
        calibration_plans=calibration_plans,
        epsilon=epsilon,
        calibrate=calibrate,
        gap_bound=gap_bound,
        seed=seed,
    )
    config.check()
    if real_time:
        from s2a_bench.experiments.timeline.real_time import run_real_time

        execute(
            lambda view: run_real_time(config, output, view), as_json=json_, per_skill=per_skill, data_only=data_only
        )
    else:
        from s2a_bench.experiments.timeline.run import run_timeline

        execute(
            lambda view: run_timeline(config, output, view), as_json=json_, per_skill=per_skill, data_only=data_only
        )


def execute(run: Callable[[TimelineView], Path], *, as_json: bool, per_skill: bool, data_only: bool) -> None:
    """Run timelines, and show what came of them."""
    from s2a_bench.cli.timeline_view import TimelineView

    view = TimelineView()
    with view:
        try:
            folder = run(view)
            if not data_only:
                view.stage("drawing")
                draw(folder)
            show(folder, view, as_json=as_json, per_skill=per_skill)
        except (S2AError, KeyboardInterrupt):
            if view.folder is not None:
                view.say(f"timelines so far: {view.folder}")
            raise


def draw(folder: Path) -> None:
    """Write tables, figures and trace of any run of timelines."""
    from s2a_bench.experiments.timeline.view.chrome_trace import write_trace
    from s2a_bench.experiments.timeline.view.figures import write_timeline_figures
    from s2a_bench.experiments.timeline.view.tables import timeline_csv, timeline_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.files import write_texts

    run = read_run(folder)
    write_texts(run, timeline_tables(run), timeline_csv(run))
    write_timeline_figures(run)
    write_trace(run)


def show(folder: Path, progress: RunProgress, *, as_json: bool, per_skill: bool) -> None:
    """Print what the user asked for of any run of timelines."""
    from s2a_bench.experiments.timeline.view.as_json import timelines_json
    from s2a_bench.experiments.timeline.view.cells import timelines_of
    from s2a_bench.experiments.timeline.view.tables import timeline_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.terminal import lay_out

    run = read_run(folder)
    tables = timeline_tables(run)
    for warning in run.manifest["warnings"]:
        progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
    if as_json:
        print_json(timelines_json(run))
        return
    console = open_console()
    one_setting = len({cell.setting for cell in timelines_of(run)}) == 1
    for name, table in tables.items():
        if name != "skills" or per_skill or one_setting:
            console.print(lay_out(table))
    for note in tables["timelines"].notes:
        console.print(note)
    trace = folder / "trace.json"
    if trace.exists():
        console.print(f"trace for ui.perfetto.dev: {trace}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
