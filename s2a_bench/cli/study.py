"""s2a-bench study: Monte Carlo studies of when to act."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def study(
    name: Annotated[
        str,
        typer.Argument(
            help="targets (what stream-to-act must reach), frontier (stalls against regret), "
            "drift (tracking lambda), misfit (wrong N, L, rate)"
        ),
    ],
    plans: Annotated[int | None, typer.Option(help="plans a cell [default: the study's own number]")] = None,
    calibration_plans: Annotated[int, typer.Option(help="plans that prior and lambda come from")] = 400,
    epsilon: Annotated[float, typer.Option(help="share of plans that may stall")] = 0.01,
    profile: Annotated[str, typer.Option(help="profile whose recorded gaps the frontier adds as a family")] = "",
    seed: Annotated[int, typer.Option(help="seed; every cell has its own from it")] = 0,
    jobs: Annotated[int, typer.Option(help="processes")] = 1,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Study when to act on drawn plans: nothing is measured, everything repeats by its seed."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.study.run import StudyConfig, run_study
    from s2a_bench.store.run import read_run

    config = StudyConfig(seed, plans, calibration_plans, epsilon, jobs, _recording(profile))
    with RunProgress("cells") as progress:
        try:
            folder = run_study(name, config, output, progress)
            run = read_run(folder)
            for warning in run.manifest["warnings"]:
                progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
            progress.stage("drawing")
            _show(run, as_json=json_)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"cells so far: {progress.folder}")
            raise


def _show(run: Run, *, as_json: bool) -> None:
    """Write tables and figure, and print what the user asked for."""
    from s2a_bench.experiments.study.view.as_json import study_json
    from s2a_bench.experiments.study.view.figures import write_study_figure
    from s2a_bench.experiments.study.view.tables import study_tables, table_files
    from s2a_bench.writers.files import write_texts
    from s2a_bench.writers.terminal import lay_out

    tables = study_tables(run)
    write_texts(run, table_files(tables), {})
    write_study_figure(run)
    if as_json:
        print_json(study_json(run))
        return
    console = open_console()
    for table in tables:
        console.print(lay_out(table))
        for note in table.notes:
            console.print(note, markup=False, highlight=False)
        console.print()
    console.print(f"run folder: {run.path}", highlight=False, markup=False, soft_wrap=True)


def _recording(name: str) -> tuple[float, ...]:
    """Return a profile's recorded gaps."""
    from s2a_bench.boards.search import load_profile
    from s2a_bench.errors import UsageError

    if not name:
        return ()
    recording = load_profile(name).trace_s
    if not recording:
        raise UsageError(f"--profile: {name} holds no recorded gaps; measure one with s2a-bench profile")
    return recording
