"""`s2a-bench boundary`: where naive execution needs no help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from s2a_bench.cli.options import listed, numbers, whole_numbers
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError


def boundary(
    profile: Annotated[
        str, typer.Option(help="boards to mark: names of 'profile list', or paths; several with commas")
    ] = "rtx-4080,jetson-agx-orin,jetson-orin-nano",
    tokens_per_skill: Annotated[str, typer.Option(help="L at which boards are marked")] = "6,4,2,1",
    most_tokens: Annotated[int, typer.Option(help="the plane has L = 1 to this")] = 8,
    rates: Annotated[str, typer.Option(help="tokens/s of the plane: from, to")] = "0.3,60",
    points: Annotated[
        int | None, typer.Option(help="rates tried between them, on a logarithmic scale [default: 25; with jitter 73]")
    ] = None,
    n_skills: Annotated[int, typer.Option(help="N, skills a plan")] = 8,
    t_nom: Annotated[float, typer.Option(help="seconds a skill takes")] = 1.0,
    t_min: Annotated[float, typer.Option(help="least duration of a skill, as a factor of T_nom")] = 0.8,
    jitter: Annotated[
        str,
        typer.Option(help="none (tokens come evenly), or a family of gaps, as lognormal:cv=0.2: P(stall) is shaded"),
    ] = "none",
    plans: Annotated[int | None, typer.Option(help="plans a point [default: 1; with jitter 2000]")] = None,
    seed: Annotated[int, typer.Option(help="seed of everything that is drawn")] = 0,
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Show at which rates and granularities naive execution never stalls: by formula, and by trying every point."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.boundary.run import BoundaryConfig, run_boundary

    config = BoundaryConfig(
        profiles=listed(profile),
        tokens_per_skill=whole_numbers("--tokens-per-skill", tokens_per_skill),
        most_tokens=most_tokens,
        rates=numbers("--rates", rates),
        points=points,
        n_skills=n_skills,
        t_nom_s=t_nom,
        t_min=t_min,
        jitter=jitter,
        plans=plans,
        seed=seed,
    )
    config.check()
    with RunProgress() as progress:
        try:
            folder = run_boundary(config, output, progress)
            if not data_only:
                progress.stage("drawing")
                _draw(folder)
            _show(folder, as_json=json_)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"points so far: {progress.folder}")
            raise


def _draw(folder: Path) -> None:
    """Write tables and figure."""
    from s2a_bench.experiments.boundary.view.figure import write_boundary_figure
    from s2a_bench.experiments.boundary.view.tables import boundary_csv, boundary_tables
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.files import write_texts

    run = read_run(folder)
    write_texts(run, boundary_tables(run), boundary_csv(run))
    write_boundary_figure(run)


def _show(folder: Path, *, as_json: bool) -> None:
    """Print what the user asked for."""
    from s2a_bench.experiments.boundary.view.tables import boundary_tables, boundary_to_json
    from s2a_bench.store.run import read_run
    from s2a_bench.writers.terminal import lay_out

    run = read_run(folder)
    tables = boundary_tables(run)
    if as_json:
        print_json(boundary_to_json(run))
        return
    console = open_console()
    for table in tables.values():
        console.print(lay_out(table))
    for note in tables["boards"].notes:
        console.print(note)
    console.print(f"run folder: {folder}", highlight=False, markup=False, soft_wrap=True)
