"""Cells on this machine: measured ones one after another, virtual ones on several cores."""

from __future__ import annotations

import signal
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from pathlib import Path

from s2a_bench.machine.children import end_with_parent
from s2a_bench.machine.environment import collect
from s2a_bench.store.manifest import utc_now
from s2a_bench.sweep import Cell, Outcome
from s2a_bench.sweep.perform import perform
from s2a_bench.sweep.plan import Plan

DIED = "the worker process died under it (out of memory?)"


class Here:
    """Two pools of processes, so that a cell that crashes or takes all memory does not take the sweep along."""

    def __init__(self, entry: str, _address: str, _plan: Plan, jobs: int) -> None:
        """Make no process yet; ``jobs`` virtual cells run at once."""
        self.width = jobs
        self._entry = entry
        self._others = set(active_children())
        self._pools: dict[bool, ProcessPoolExecutor] = {}

    def submit(self, cell: Cell, folder: Path) -> Future[Outcome]:
        """Hand a cell to a process."""
        try:
            return self._pool(cell.virtual).submit(perform, cell, folder, self._entry)
        except BrokenProcessPool:  # an earlier cell broke it
            del self._pools[cell.virtual]
            return self._pool(cell.virtual).submit(perform, cell, folder, self._entry)

    def collect(self, future: Future[Outcome], folder: Path) -> Outcome:  # noqa: ARG002 - it lies there already
        """Return how a cell went."""
        try:
            return future.result()
        except BrokenProcessPool:
            return Outcome(DIED, 0.0, utc_now(), collect())

    def _pool(self, virtual: bool) -> ProcessPoolExecutor:
        if virtual not in self._pools:
            self._pools[virtual] = ProcessPoolExecutor(
                self.width if virtual else 1, mp_context=get_context("spawn"), initializer=prepare
            )
        return self._pools[virtual]

    def __enter__(self) -> Here:  # noqa: PYI034 - Self is typing's since 3.11
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the pools; after an interruption end what they are doing."""
        for pool in self._pools.values():
            pool.shutdown(wait=kind is None, cancel_futures=True)
        if kind is not None:
            for child in set(active_children()) - self._others:
                child.terminate()  # a measured cell's process sees it, and closes its run folder
                child.join()


def prepare() -> None:
    """Prepare a worker: Ctrl-C is the sweep's to handle, and nothing outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
