"""`s2a-bench sweep`: a grid of settings from a file, which survives crashes and goes on where it was."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from s2a_bench.cli import sweep_cells
from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json
from s2a_bench.errors import S2AError
from s2a_bench.sweep import WORKERS
from s2a_bench.sweep.config import SweepConfig

if TYPE_CHECKING:
    from s2a_bench.sweep import Workers
    from s2a_bench.sweep.plan import Plan


def _sweep(config: SweepConfig, *, json_: Json = False) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.store.run import RunWriter
    from s2a_bench.store.sweep import CELLS
    from s2a_bench.sweep.file import read_sweep_file
    from s2a_bench.sweep.plan import plan_sweep
    from s2a_bench.sweep.run import SweepRun, check_resume, only_one, start_sweep

    resume, source, boards = config.resume, config.source, config.boards
    found = read_sweep_file(source)
    plan = plan_sweep(found, sweep_cells.command_of(found.command, f"{source}: command"), boards)
    if resume is not None:
        check_resume(resume, plan)
    if config.dry_run:
        _show_plan(plan, config, as_json=json_)
        return
    with RunProgress("cells") as progress, ExitStack() as stack:
        workers = _workers(plan, config.ray, config.width)
        if resume is not None:
            stack.enter_context(only_one(resume))
        writer = RunWriter.reopen(resume, [CELLS]) if resume else start_sweep(plan, source, config.output, boards)
        if resume is None:
            stack.enter_context(only_one(writer.path))
        progress.opened(writer.path)
        try:
            with writer:
                run = SweepRun(writer, plan, progress)
                with workers:
                    run.work(run.pending(retry_failed=config.retry_failed), workers)
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


def _workers(plan: Plan, ray: str, width: int) -> Workers:
    """Choose where cells run."""
    made: Any = resolve_name(WORKERS["ray" if ray else "here"])
    workers: Workers = made(sweep_cells.ENTRY, ray, plan, width)
    return workers


def _show_plan(plan: Plan, config: SweepConfig, *, as_json: bool) -> None:
    """Print what would run, and how long it would take."""
    from s2a_bench.cli.sweep_text import print_plan
    from s2a_bench.machine.environment import collect
    from s2a_bench.store.sweep import read_sweep
    from s2a_bench.sweep.as_json import plan_json
    from s2a_bench.sweep.run import pending
    from s2a_bench.sweep.timing import earlier, expect

    resume = config.resume
    cells = pending(plan, read_sweep(resume).attempts.to_dict("records") if resume else [], retry_failed=False)
    sweeps = earlier(resume.parent if resume else config.output, plan.command)
    expected = expect(cells, plan.rest_s, config.width, sweeps, _workers(plan, "", config.width))
    if as_json:
        print_json(plan_json(cells, expected, collect()))
        return
    print_plan(plan, cells, expected)


def _show(folder: Path, *, as_json: bool) -> None:
    """Print how the cells went."""
    from s2a_bench.cli.sweep_text import print_sweep
    from s2a_bench.store.sweep import read_sweep
    from s2a_bench.sweep.as_json import sweep_json

    found = read_sweep(folder)
    if as_json:
        print_json(sweep_json(found))
        return
    print_sweep(found)


sweep = command(_sweep, SweepConfig)
