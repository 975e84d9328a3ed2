"""`s2a-bench ccrb`: the driving scenario under each policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.options import listed, numbers
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.cli.timeline_live import given_live, live_config, refuse_with_live, refuse_without_live
from s2a_bench.errors import S2AError, UsageError

if TYPE_CHECKING:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.ccrb.config import CcrbConfig
    from s2a_bench.experiments.timeline.live.config import LiveConfig

PROFILE = "jetson-agx-orin"
REPLAY_TOKENS = 6
"""Tokens a skill of ``--engine replay``, which writes household plans whatever it is asked."""


def ccrb(
    policy: Annotated[
        str, typer.Option(help="naive, wait-then-act, stream-to-act, and those for study; several with commas")
    ] = "naive,wait-then-act,stream-to-act",
    profile: Annotated[str, typer.Option(help="the board: a name of 'profile list', or a path")] = PROFILE,
    rate: Annotated[float | None, typer.Option(help="a board of which only the tokens/s are known")] = None,
    prompt_time: Annotated[
        float | None, typer.Option(help="seconds before decoding, c [default: the profile's; with --rate 0]")
    ] = None,
    tokens_per_skill: Annotated[int, typer.Option(help="L, the delimiter included")] = 6,
    skills: Annotated[int, typer.Option(help="N, speed set-points down to rest")] = 5,
    t_nom: Annotated[
        float | None, typer.Option(help="seconds a set-point takes [default: the skill set's 0.8]")
    ] = None,
    speed: Annotated[float, typer.Option(help="of all three cars in the beginning, km/h")] = 50.0,
    plan_decel: Annotated[
        float | None, typer.Option(help="m/s^2 that the plan brakes with [default: as needed to come to rest]")
    ] = None,
    front_gap: Annotated[float, typer.Option(help="m to the lead; Euro NCAP: 12 or 40")] = 40.0,
    lead_decel: Annotated[float, typer.Option(help="m/s^2 of the lead; Euro NCAP: 2 or 6")] = 2.0,
    rear_gap: Annotated[float, typer.Option(help="m to the car behind")] = 14.0,
    reaction: Annotated[float, typer.Option(help="seconds until the car behind reacts")] = 1.3,
    gap_behaviour: Annotated[
        str, typer.Option(help="what the ego does while no skill is valid: stop, coast, hold, cruise")
    ] = "stop",
    follower: Annotated[str, typer.Option(help="the law of the car behind: careful, idm")] = "careful",
    simulator: Annotated[
        str, typer.Option(help="longitudinal (along the lane), embedded (highway-env), carla")
    ] = "longitudinal",
    host: Annotated[str, typer.Option(help="carla: where the server is, HOST or HOST:PORT")] = "localhost:2000",
    reflex: Annotated[bool, typer.Option("--reflex", help="let the ego brake by itself below the plan")] = False,
    ttc: Annotated[
        bool, typer.Option("--ttc", help="add s2a-ttc: stream-to-act that starts by the lead's deadline")
    ] = False,
    lane_change: Annotated[
        bool, typer.Option("--lane-change", help="end the plan with a lane change; not along the lane")
    ] = False,
    phase: Annotated[
        bool, typer.Option("--phase", help="also the phase diagram over rate and rear gap, for every gap behaviour")
    ] = False,
    phase_rates: Annotated[str, typer.Option(help="tokens/s of the phase diagram: from, to")] = "2,12",
    phase_gaps: Annotated[str, typer.Option(help="m to the car behind in the phase diagram: from, to")] = "6,30",
    random: Annotated[int, typer.Option(help="also as many random scenarios; 0: none")] = 0,
    seed: Annotated[int, typer.Option(help="seed of everything that is drawn")] = 0,
    live: Annotated[
        bool, typer.Option("--live", help="take the tokens of a model that really answers, about the rendered scene")
    ] = False,
    transport: Annotated[
        str | None, typer.Option(help="--live: ros, ros/action, http, http/VARIANT, loopback [default: ros]")
    ] = None,
    pace: Annotated[
        float | None, typer.Option(help="--live: hold the answer back to so many tokens/s [default: the model's own]")
    ] = None,
    engine: Annotated[str | None, typer.Option(help="--live: llama, replay (EMULATED) [default: llama]")] = None,
    model: Annotated[str | None, typer.Option(help="--live: GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[str | None, typer.Option(help="--live: GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int | None, typer.Option(min=0, help="--live: CPU threads of the model [default: all]")] = None,
    animation: Annotated[
        bool, typer.Option("--animation/--no-animation", help="write the animation (GIF, MP4): half a minute")
    ] = False,
    openscenario: Annotated[
        Path | None, typer.Option(help="also write the scenario as an OpenSCENARIO file, its road beside it")
    ] = None,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Drive car-to-car rear braking with a car behind, under each policy, in virtual time: who hits whom, and when."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.ccrb.config import CcrbConfig

    for_live = {"transport": transport, "pace": pace, "engine": engine}
    given = given_live({**for_live, "model": model, "mmproj": mmproj, "threads": threads})
    if live:
        modelled: dict[str, tuple[Any, Any]] = {"rate": (rate, None), "prompt-time": (prompt_time, None)}
        modelled |= {"phase": (phase, False), "random": (random, 0), "openscenario": (openscenario, None)}
        modelled |= {} if engine == "replay" else {"profile": (profile, PROFILE)}
        refuse_with_live(modelled)
        rate = pace  # what is known of the plan's length beforehand
    else:
        refuse_without_live(given)
    config = CcrbConfig(
        policies=listed(policy),
        profile=profile,
        rate=rate,
        prompt_s=prompt_time,
        tokens_per_skill=tokens_per_skill,
        n_skills=skills,
        t_nom_s=t_nom,
        speed_kmh=speed,
        plan_decel_mps2=plan_decel,
        front_gap_m=front_gap,
        lead_decel_mps2=lead_decel,
        rear_gap_m=rear_gap,
        reaction_s=reaction,
        gap=gap_behaviour,
        follower=follower,
        simulator=simulator,
        reflex=reflex,
        ttc=ttc,
        lane_change=lane_change,
        phase=phase,
        phase_rates=numbers("--phase-rates", phase_rates),
        phase_gaps_m=numbers("--phase-gaps", phase_gaps),
        random=random,
        seed=seed,
    )
    asked = _asked(config, given) if live else None
    config.check()
    if asked is not None:
        asked.check()
    with RunProgress() as progress:
        try:
            settings: dict[str, Any] = {"host": host} if simulator == "carla" else {}
            if openscenario is not None:
                _write_scenario(config, openscenario, progress)
            folder = _run(config, asked, output, progress, settings)
            if not data_only:
                progress.stage("drawing")
                _draw(folder, progress, animated=animation)
            _show(folder, progress, as_json=json_)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"roll-outs so far: {progress.folder}")
            raise


def _asked(config: CcrbConfig, given: dict[str, Any]) -> LiveConfig:
    """Word what is asked of the model; raises UsageError naming the flag."""
    from s2a_bench.experiments.ccrb.config import SKILL_SET

    replayed = given.get("engine") == "replay"
    if replayed and config.tokens_per_skill != REPLAY_TOKENS:
        raise UsageError(f"--engine replay writes {REPLAY_TOKENS} tokens a skill; leave out --tokens-per-skill")
    return live_config(
        {**given, "skills": "household" if replayed else SKILL_SET},
        policy=",".join(config.policies),
        profile=config.profile if replayed else "",
        tokens_per_skill=str(config.tokens_per_skill),
        n_skills=str(config.n_skills + config.lane_change),
        t_nom="",
        t_min=0.8,
        t_max=1.5,
        plans=1,
        seed=config.seed,
    )


def _run(
    config: CcrbConfig, asked: LiveConfig | None, output: Path, progress: RunProgress, settings: dict[str, Any]
) -> Path:
    """Run with modelled tokens, or with those that a model is asked for."""
    if asked is None:
        from s2a_bench.experiments.ccrb.run import run_ccrb

        return run_ccrb(config, output, progress, **settings)
    from s2a_bench.experiments.ccrb.live import run_ccrb_live

    return run_ccrb_live(config, asked, output, progress, **settings)


def _write_scenario(config: CcrbConfig, path: Path, progress: RunProgress) -> None:
    """Write the OpenSCENARIO file and its road."""
    from s2a_bench.experiments.ccrb.plans import prepare
    from s2a_bench.scenario.ccrb.openscenario import write_openscenario

    ready = prepare(config)
    for written in write_openscenario(path, config.cars, ready.driving, ready.schedules):
        progress.say(f"scenario: {written}")


def _draw(folder: Path, progress: RunProgress, *, animated: bool) -> None:
    """Write tables, figures and animation."""
    from s2a_bench.experiments.ccrb.view.figures import write_ccrb_figures
    from s2a_bench.experiments.ccrb.view.tables import ccrb_csv, ccrb_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.files import write_texts

    run = read_run(folder)
    write_texts(run, ccrb_tables(run), ccrb_csv(run))
    write_ccrb_figures(run)
    if animated:
        from s2a_bench.experiments.ccrb.view.animation import write_animation

        progress.stage("drawing the animation")
        for path in write_animation(run):
            progress.say(f"animation: {path}")


def _show(folder: Path, progress: RunProgress, *, as_json: bool) -> None:
    """Print what the user asked for."""
    from s2a_bench.experiments.ccrb.view.as_json import ccrb_to_json
    from s2a_bench.experiments.ccrb.view.outcomes import words
    from s2a_bench.experiments.ccrb.view.tables import ccrb_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.terminal import lay_out

    run = read_run(folder)
    tables = ccrb_tables(run)
    for doubt in run.manifest.get("warnings", []):
        progress.say(f"warning [{doubt['code']}]: {doubt['message']}; {doubt['advice']}")
    if speed := run.manifest.get("studies", {}).get("rollouts_per_cpu_s"):
        progress.say(f"{run.manifest['studies']['rollouts']} roll-outs, {speed:.0f} a second of processor time")
    if as_json:
        print_json(ccrb_to_json(run))
        return
    console = open_console()
    for table in tables.values():
        console.print(lay_out(table))
        for note in table.notes:
            console.print(note, markup=False, highlight=False)
        console.print()
    for line in words(run):
        console.print(line, markup=False, highlight=False)
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
