"""`s2a-bench sweep`: a grid of settings from a file, which survives crashes and goes on where it was."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.options import listed
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError, UsageError
from s2a_bench.store.sweep import CELLS

if TYPE_CHECKING:
    from s2a_bench.sweep import Workers
    from s2a_bench.sweep.plan import Plan


def sweep(
    file: Annotated[
        str, typer.Argument(help="sweep file (TOML), or the name of one: paper, quick; not needed with --resume")
    ] = "",
    resume: Annotated[
        Path | None, typer.Option(help="folder of a sweep that was interrupted: run what it has not run yet")
    ] = None,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="with --resume: run the cells that failed once more")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="print the cells and how long they will take, and run nothing")
    ] = False,
    board: Annotated[
        str, typer.Option(help="what this machine is in the file's 'board' axis; several with commas")
    ] = "",
    ray: Annotated[
        str, typer.Option(help="run on a Ray cluster: its ADDRESS, auto, or local (a cluster of this machine)")
    ] = "",
    jobs: Annotated[int, typer.Option(min=0, help="virtual cells at once on this machine; 0: one a core")] = 0,
    output: Annotated[Path, typer.Option(help="folder for the sweep's folder")] = Path("results"),
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Run a command once for every cell of a grid; every finished cell is kept at once, and a sweep can go on later."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.store.run import RunWriter
    from s2a_bench.sweep.file import find_sweep
    from s2a_bench.sweep.run import COPY, SweepRun, check_resume, only_one, start_sweep

    if retry_failed and resume is None:
        raise UsageError("--retry-failed: name the sweep's folder with --resume")
    if board and ray:
        raise UsageError("--board and --ray are two things: on Ray every node offers its own boards")
    boards = None if ray else listed(board) or _boards_before(resume)
    source = find_sweep(file) if file else resume and resume / COPY
    if source is None:
        raise UsageError("name a sweep file, or the folder of a sweep with --resume")
    plan = _plan(source, boards)
    if resume is not None:
        check_resume(resume, plan)
    jobs = jobs or len(os.sched_getaffinity(0))
    if dry_run:
        _show_plan(plan, jobs, resume, resume.parent if resume else output, as_json=json_)
        return
    with RunProgress("cells") as progress, ExitStack() as stack:
        workers = _workers(plan, ray, jobs)
        if resume is not None:
            stack.enter_context(only_one(resume))
        writer = RunWriter.reopen(resume, [CELLS]) if resume else start_sweep(plan, source, output, boards)
        if resume is None:
            stack.enter_context(only_one(writer.path))
        progress.opened(writer.path)
        try:
            with writer:
                run = SweepRun(writer, plan, progress)
                with workers:
                    run.work(run.pending(retry_failed=retry_failed), workers)
                run.finish()
        except (S2AError, KeyboardInterrupt):
            progress.say(f"sweep so far: {writer.path}; go on with: s2a-bench sweep --resume {writer.path}")
            raise
    _show(writer.path, as_json=json_)
    if run.failed:
        raise S2AError(
            f"{run.failed} of {len(plan.cells)} cells failed; run them again with: "
            f"s2a-bench sweep --resume {writer.path} --retry-failed"
        )


def _boards_before(folder: Path | None) -> tuple[str, ...]:
    """Return what this machine was called when a sweep began."""
    from s2a_bench.store.run import read_run

    return tuple(read_run(folder).manifest["configuration"].get("boards") or ()) if folder else ()


def _plan(source: Path, boards: Sequence[str] | None) -> Plan:
    """Read a sweep file as cells."""
    from s2a_bench.cli.sweep_cells import command_of
    from s2a_bench.sweep.file import read_sweep_file
    from s2a_bench.sweep.plan import plan_sweep

    found = read_sweep_file(source)
    return plan_sweep(found, command_of(found.command, f"{source}: command"), boards)


def _workers(plan: Plan, ray: str, jobs: int) -> Workers:
    """Choose where cells run."""
    from pkgutil import resolve_name

    from s2a_bench.cli.sweep_cells import ENTRY
    from s2a_bench.sweep import WORKERS

    made: Any = resolve_name(WORKERS["ray" if ray else "here"])
    workers: Workers = made(ENTRY, ray, plan, jobs)
    return workers


def _show_plan(plan: Plan, jobs: int, resume: Path | None, output: Path, *, as_json: bool) -> None:
    """Print what would run, and how long it would take."""
    from s2a_bench.cli import sweep_text
    from s2a_bench.machine.environment import collect
    from s2a_bench.store.sweep import read_sweep
    from s2a_bench.sweep.run import pending
    from s2a_bench.sweep.timing import earlier, expect

    rows = read_sweep(resume).attempts.to_dict("records") if resume else []
    cells = pending(plan, rows, retry_failed=False)
    workers = _workers(plan, "", jobs)
    expected = expect(cells, plan.rest_s, jobs, earlier(output, plan.command), workers)
    if as_json:
        print_json(sweep_text.plan_json(cells, expected, collect()))
        return
    sweep_text.print_plan(plan, cells, expected)


def _show(folder: Path, *, as_json: bool) -> None:
    """Print how the cells went."""
    from s2a_bench.cli import sweep_text
    from s2a_bench.store.sweep import read_sweep

    found = read_sweep(folder)
    if as_json:
        print_json(sweep_text.sweep_json(found))
        return
    sweep_text.print_sweep(found)
