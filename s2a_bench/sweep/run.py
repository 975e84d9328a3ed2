"""Run a sweep: every finished cell is on disk with its row; resume a sweep; estimate its time."""

from __future__ import annotations

import fcntl
import shutil
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.machine import environment
from s2a_bench.progress import Progress
from s2a_bench.store.manifest import SWEEP
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.store.sweep import CELLS, CellRow, is_sweep
from s2a_bench.sweep import COPY, CellWorkers, Outcome, SweepCell
from s2a_bench.sweep.perform import run_folder
from s2a_bench.sweep.plan import SweepPlan

UNDER_WAY = ".under-way"
"""Folder of the running cells; what a killed sweep leaves there is lost."""


def start_sweep(plan: SweepPlan, source: Path, output: Path, boards: Sequence[str] | None) -> RunWriter:
    """Make the sweep's folder; ``boards`` are the names of this machine, None on Ray. Raises StoreError."""
    facts = {
        "configuration": {
            "command": plan.command,
            "hash": plan.config_hash,
            "file": str(source),
            "cells": len(plan.cells),
            "repeats": plan.repeats,
            "rest_s": plan.rest_s,
            "boards": boards and list(boards),
        },
        "environment": environment.collect(),
        "seeds": {"sweep": plan.seed},
        "machines": {},
        "boards": {},
    }
    writer = RunWriter.create(output, SWEEP, facts, (CELLS,))
    (writer.path / COPY).write_bytes(source.read_bytes())
    return writer


def check_resume(folder: Path, plan: SweepPlan) -> None:
    """Raise UsageError if the folder is of another configuration or of another machine."""
    run = read_run(folder)
    if not is_sweep(run.manifest):
        raise UsageError(f"`resume`: {folder} is the folder of a {run.manifest['command']} run, not of a sweep")
    if run.manifest["configuration"].get("hash") != plan.config_hash:
        raise UsageError(
            f"`resume`: the sweep in {folder} was another one: its file is {folder / COPY}, and the profiles and files "
            "that it names count too; start a new sweep, or undo the changes"
        )
    if other := difference(facts_of(environment.collect()), facts_of(run.manifest["environment"])):
        raise UsageError(
            f"`resume`: {folder} was measured on another machine: {other}; resume it there, or start a new sweep"
        )


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Lock a sweep's folder; raises StoreError if another process holds it."""
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(f"{folder}: another s2a-bench sweep is writing it; wait for it, or stop it") from error
        yield


def latest(rows: Iterable[Mapping[Any, Any]]) -> dict[tuple[str, int], tuple[int, str]]:
    """Return cell and repeat -> number and state of the last attempt."""
    return {(row["cell"], row["repeat"]): (row["attempt"], row["state"]) for row in rows}


def pending(plan: SweepPlan, rows: Iterable[Mapping[Any, Any]], *, retry_failed: bool) -> list[SweepCell]:
    over = {"finished"} if retry_failed else {"finished", "failed"}
    ended = latest(rows)
    return [cell for cell in plan.cells if ended.get(cell.key, (0, ""))[1] not in over]


class SweepRun:
    def __init__(self, writer: RunWriter, plan: SweepPlan, progress: Progress, clock: Clock | None = None) -> None:
        """Read the rows of earlier sessions; the folder must be held by `only_one`."""
        self._writer = writer
        self._plan = plan
        self._progress = progress
        self._clock = clock or SystemClock()
        shutil.rmtree(writer.path / UNDER_WAY, ignore_errors=True)
        self._rows = read_run(writer.path).table(CELLS).to_dict("records")
        self._latest = latest(self._rows)

    @property
    def failed(self) -> int:
        return sum(state == "failed" for _, state in self._latest.values())

    def work(self, workers: CellWorkers, *, retry_failed: bool) -> None:
        """Run pending cells: the measured ones, one at a time on each board, then the virtual ones, many at once."""
        cells = pending(self._plan, self._rows, retry_failed=retry_failed)
        self._progress.expect(len(cells))
        lanes: dict[str, deque[SweepCell]] = {}
        for cell in cells:
            if not cell.virtual:
                lanes.setdefault(cell.board, deque()).append(cell)
        self._drain(lanes, dict.fromkeys(lanes, 1), workers, round(self._plan.rest_s * 1e9))
        virtual = deque(cell for cell in cells if cell.virtual)
        self._drain({"": virtual}, {"": workers.width}, workers, 0)

    def finish(self) -> None:
        shutil.rmtree(self._writer.path / UNDER_WAY, ignore_errors=True)
        error = f"{self.failed} of {len(self._plan.cells)} cells failed" if self.failed else None
        self._writer.finish("failed" if error else "finished", error)

    def _drain(
        self, lanes: dict[str, deque[SweepCell]], width: dict[str, int], workers: CellWorkers, rest_ns: int
    ) -> None:
        running: dict[Future[Any], tuple[str, SweepCell, Path]] = {}
        ready_ns = dict.fromkeys(lanes, 0)
        while running or any(lanes.values()):
            now = self._clock.now_ns()
            for lane, waiting in lanes.items():
                free = width[lane] - sum(name == lane for name, _, _ in running.values())
                while waiting and free > 0 and ready_ns[lane] <= now:
                    cell, free = waiting.popleft(), free - 1
                    folder = self._writer.path / UNDER_WAY / cell.label
                    self._progress.stage(f"{self._plan.command} {'cells' if cell.virtual else cell.label}")
                    running[workers.submit(cell, folder)] = lane, cell, folder
            rests = [ready_ns[lane] for lane, waiting in lanes.items() if waiting and ready_ns[lane] > now]
            if not running:
                self._clock.sleep_until_ns(min(rests))
                continue
            done, _ = wait(running, (min(rests) - now) / 1e9 if rests else None, FIRST_COMPLETED)
            for future in done:
                lane, cell, folder = running.pop(future)
                self._keep(cell, workers.collect(future, folder), folder)
                ready_ns[lane] = self._clock.now_ns() + rest_ns

    def _keep(self, cell: SweepCell, outcome: Outcome, folder: Path) -> None:
        """Move a cell's run folder to its place and append its row; then it is done."""
        attempt = self._latest.get(cell.key, (0, ""))[0] + 1
        host = str(outcome.machine.get("host", ""))
        error = outcome.error or self._other_machine(cell, outcome)
        run = run_folder(folder) if folder.exists() else None
        kept = self._writer.path / "cells" / (cell.label + (f"-{attempt}" if attempt > 1 else ""))
        if run is not None:
            kept.parent.mkdir(exist_ok=True)
            shutil.rmtree(kept, ignore_errors=True)  # of a sweep killed between move and row
            run.rename(kept)
        shutil.rmtree(folder, ignore_errors=True)
        if host not in self._writer.manifest["machines"]:
            self._writer.update(machines={host: outcome.machine})
        row = CellRow(
            cell=cell.name,
            **{name: getattr(cell, name) for name in ("repeat", "virtual", "board", "settings", "config_hash")},
            attempt=attempt,
            state="failed" if error else "finished",
            error=error,
            host=host,
            argv=list(cell.argv),
            folder=str(kept.relative_to(self._writer.path)) if run is not None else "",
            started=outcome.started,
            wall_s=outcome.wall_s,
            provenance=read_run(kept).origins.code if run is not None else "",
        )
        self._writer.append(CELLS, [row])
        self._latest[cell.key] = attempt, row.state
        if error:
            self._progress.stage(f"cell {cell.name} failed: {error}")
        self._progress.advance()

    def _other_machine(self, cell: SweepCell, outcome: Outcome) -> str:
        """Record the machine of a board; return an error if a cell ran on a different one."""
        if not cell.board or cell.virtual:
            return ""
        kind = facts_of(outcome.machine, KIND)
        boards = self._writer.manifest["boards"]
        if cell.board not in boards:
            self._writer.update(boards={cell.board: kind})
        other = difference(kind, boards[cell.board])
        return f"{cell.board} is another machine than before: {other}" if other else ""


KIND = ("s2a_bench", "machine", "board", "cpu", "cores", "gpus", "power_mode")
IDENTITY = ("host", *KIND)


def facts_of(environment: dict[str, Any], names: tuple[str, ...] = IDENTITY) -> dict[str, Any]:
    """Return the facts that identify a machine; an unreadable one is absent."""
    return {name: environment[name] for name in names if name in environment}


def difference(now: dict[str, Any], then: dict[str, Any]) -> str:
    names = [name for name in IDENTITY if now.get(name) != then.get(name)]
    return ", ".join(f"{name} is {_plain(now.get(name))}, was {_plain(then.get(name))}" for name in names)


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return " + ".join(str(each.get("name", each)) for each in value)
    return "unknown" if value is None else str(value)
