"""Run one cell, in this process if it is virtual, else in its own; and many of them, on this machine or on Ray."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import tarfile
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from pkgutil import resolve_name
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeAlias

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError, StoreError, UsageError, how_it_ended
from s2a_bench.machine.cluster import connect
from s2a_bench.machine.environment import collect
from s2a_bench.machine.tuning import end_with_parent, obey_parent
from s2a_bench.store import manifest as manifests
from s2a_bench.sweep import CellWorkers, Outcome, SweepCell
from s2a_bench.sweep.plan import SweepPlan

RETRIES: Final = 5
AHEAD: Final = 2
"""Virtual cells submitted for each core: one runs, one waits."""

Packed: TypeAlias = tuple[Outcome, bytes]


def perform(cell: SweepCell, folder: Path, entry: str) -> Outcome:
    """Run a cell with ``--output`` at a new folder; ``entry`` is the command line as "module:function"."""
    folder.mkdir(parents=True)
    argv = [*cell.argv, f"--output={folder}"]
    started, before_ns = manifests.utc_now(), now_ns()
    error = _inside(argv, entry) if cell.virtual else _outside(argv, folder / "stderr.txt")
    wall_s = (now_ns() - before_ns) / 1e9
    path = run_folder(folder)
    if path is None and not error:
        error = "it left no run folder"
    try:
        environment = manifests.read(path)["environment"] if path else collect()
    except StoreError as damage:
        environment, error = collect(), error or str(damage)
    return Outcome(error, wall_s, started, environment)


def run_folder(folder: Path) -> Path | None:
    return next((path.parent for path in folder.glob(f"*/{manifests.NAME}")), None)


def _inside(argv: list[str], entry: str) -> str:
    """Run the command in this process without output; return its error."""
    run: Any = resolve_name(entry)
    arguments = sys.argv
    sys.argv = ["s2a-bench", *argv]  # for the run's manifest
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            run(argv)
    except S2AError as error:
        return str(error)
    except Exception as error:  # noqa: BLE001 - it is the cell's error, and the other cells run
        return f"{type(error).__name__}: {error}"
    finally:
        sys.argv = arguments
    return ""


def _outside(argv: list[str], log: Path) -> str:
    """Run the command as a user does, in a process that may crash; return its error."""
    with log.open("wb") as errors:
        done = subprocess.run(  # noqa: S603 - our own command line
            [sys.executable, "-m", "s2a_bench", *argv],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            check=False,
            start_new_session=True,  # the sweep handles Ctrl-C
            preexec_fn=partial(end_with_parent, signal.SIGTERM),
        )
    if not done.returncode:
        return ""
    lines = log.read_text(errors="replace").strip().splitlines()
    errors_of_cell = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    last_line = f": {lines[-1][:200]}" if lines else ""
    return errors_of_cell[-1] if errors_of_cell else f"{how_it_ended(done.returncode)}{last_line}"


class LocalWorkers(CellWorkers):
    """Two pools of processes: a cell that crashes or exhausts memory does not end the sweep."""

    def __init__(self, entry: str, jobs: int) -> None:
        self.width = jobs
        self._entry = entry
        self._others = set(active_children())
        self._pools: dict[bool, ProcessPoolExecutor] = {}

    def submit(self, cell: SweepCell, folder: Path) -> Future[Outcome]:
        while True:
            try:
                return self._pool(cell.virtual).submit(perform, cell, folder, self._entry)
            except BrokenProcessPool:  # an earlier cell broke it
                del self._pools[cell.virtual]

    def collect(self, future: Future[Outcome], folder: Path) -> Outcome:  # noqa: ARG002 - the worker has written into it
        try:
            return future.result()
        except BrokenProcessPool:
            return Outcome("the worker process died under it (out of memory?)", 0.0, manifests.utc_now(), collect())

    def _pool(self, virtual: bool) -> ProcessPoolExecutor:
        if virtual not in self._pools:
            self._pools[virtual] = ProcessPoolExecutor(
                self.width if virtual else 1, mp_context=get_context("spawn"), initializer=obey_parent
            )
        return self._pools[virtual]

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for pool in self._pools.values():
            pool.shutdown(wait=kind is None, cancel_futures=True)
        if kind is not None:
            for child in set(active_children()) - self._others:
                child.terminate()  # a measured cell's process sees it, and closes its run folder
                child.join()


class RayWorkers(CellWorkers):
    """A running cluster, or one of this machine's cores made for the sweep.

    A measured cell runs on the node with its board, virtual ones on every core of every node. A node offers its board
    as a custom resource, ``ray start --address=HEAD:6379 --resources='{"board:NAME": 1}'``. A cell's run folder is
    returned through Ray, so that nodes need no common disk. Ray runs the cells of a lost node again on another one, or
    waits until a node has the board.
    """

    def __init__(self, entry: str, address: str, plan: SweepPlan, jobs: int) -> None:
        """Connect; raises MissingExtra without Ray, UsageError for an unreachable cluster or a missing board."""
        ray = self._ray = connect(address, jobs)
        self._entry = entry
        self._refs: set[Any] = set()
        resources = ray.cluster_resources()
        try:
            _check(plan, resources)
        except UsageError:
            ray.shutdown()
            raise
        self.width = max(AHEAD * int(resources.get("CPU", 1)), 1)
        self._remote = ray.remote(max_retries=RETRIES)(packed)

    def submit(self, cell: SweepCell, folder: Path) -> Future[Packed]:  # noqa: ARG002 - `collect` unpacks into it
        wants = {} if cell.virtual else {"resources": {resource(cell.board): 1}}
        ref = self._remote.options(name=cell.label, **wants).remote(cell, self._entry)
        self._refs.add(ref)
        future: Future[Packed] = ref.future()
        future.add_done_callback(lambda _: self._refs.discard(ref))
        return future

    def collect(self, future: Future[Packed], folder: Path) -> Outcome:
        try:
            outcome, data = future.result()
        except self._ray.exceptions.RayError as error:
            return Outcome(f"Ray gave up: {str(error).splitlines()[0]}", 0.0, manifests.utc_now(), collect())
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(folder, filter="data")  # it refuses members that lead out of the folder
        return outcome

    def __exit__(self, *_: object) -> None:
        for ref in list(self._refs):
            self._ray.cancel(ref, force=True)
        self._ray.shutdown()


def _check(plan: SweepPlan, resources: Mapping[str, float]) -> None:
    boards = dict.fromkeys(cell.board for cell in plan.cells if cell.board)
    missing = [board for board in boards if not resources.get(resource(board))]
    if missing:
        offered = ", ".join(name.partition(":")[2] for name in resources if name.startswith("board:"))
        raise UsageError(
            f"`ray`: no node offers {', '.join(missing)} (offered: {offered or 'none'}); start Ray there with "
            f"--resources='{{\"{resource(missing[0])}\": 1}}'"
        )
    if any(not cell.virtual and not cell.board for cell in plan.cells):
        raise UsageError('`ray`: cells that measure need a machine: add board = "NAME" to the sweep file\'s settings')


def resource(board: str) -> str:
    return f"board:{board}"


def packed(cell: SweepCell, entry: str) -> Packed:
    """Run a cell on a node; return its outcome and its folder as a tar file."""
    with TemporaryDirectory(prefix="s2a-bench-cell-") as place:
        folder = Path(place) / "cell"
        outcome = perform(cell, folder, entry)
        data = io.BytesIO()
        with tarfile.open(fileobj=data, mode="w:gz", compresslevel=1) as archive:
            archive.add(folder, arcname=".")
        return outcome, data.getvalue()
