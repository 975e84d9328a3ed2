"""Cells on a Ray cluster: a measured one runs on the node with its board, virtual ones on every core of every node.

A node offers its board as a custom resource, ``ray start --address=HEAD:6379 --resources='{"board:NAME": 1}'``.
A cell's run folder is returned through Ray, so that nodes need no common disk. Ray runs the cells of a lost node again
on another one, or waits until a node has the board.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.machine.cluster import connect
from s2a_bench.machine.environment import collect
from s2a_bench.store.manifest import utc_now
from s2a_bench.sweep import CellWorkers, Outcome, SweepCell
from s2a_bench.sweep.perform import perform
from s2a_bench.sweep.plan import SweepPlan

RETRIES: Final = 5
AHEAD: Final = 2
"""Virtual cells submitted for each core: one runs, one waits."""

Packed: TypeAlias = tuple[Outcome, bytes]


class RayWorkers(CellWorkers):
    """A running cluster, or one of this machine's cores made for the sweep."""

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
            return Outcome(f"Ray gave up: {str(error).splitlines()[0]}", 0.0, utc_now(), collect())
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(folder, filter="data")
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
