"""How a run of `toy-clock` is shown: one metric, and everything that follows from it."""

from __future__ import annotations

from s2a_bench.experiments import Compared, Metric, Subject
from s2a_bench.experiments.plain import plain_view
from s2a_bench.store.run import Run
from s2a_toy.clock_run import READINGS

METRICS = {"cost": Metric("cost", "ns", title="cost of a reading")}


def subjects(run: Run) -> list[Subject]:
    """Return the one cell of a run."""
    rows = run.table(READINGS)
    values = rows["cost_ns"].to_numpy(dtype="float64")[:, None]
    return [Subject("monotonic", {}, len(rows), 0, lambda _name: list(values))]


COMPARED = Compared(METRICS, subjects, lambda _run: (), ("cost",))
show = plain_view(COMPARED)
