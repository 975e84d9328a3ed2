"""How a run of `toy-clock` is shown: its one metric, as a table, as JSON, in comparisons, and lanes on the page."""

from __future__ import annotations

from typing import Any

from s2a_bench.experiments import Comparable, Metric, Shown, Subject
from s2a_bench.stats import summary_of
from s2a_bench.stats.batches import Rows
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.json import frame, summaries
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes
from s2a_bench.writers.tables import ABSENT, TextTable, number
from s2a_toy.clock_run import READINGS

COST = Metric("cost", "ns", title="cost of a reading")


def subjects(run: StoredRun) -> list[Subject]:
    """Return the one cell of a run."""
    rows = run.table(READINGS)
    values = Rows(rows["cost_ns"].to_numpy(dtype="float64"))
    return [Subject("monotonic", {}, len(rows), 0, lambda _name: values)]


COMPARED = Comparable({"cost": COST}, subjects, lambda _run: (), ("cost",))


def show(run: StoredRun, **_: Any) -> Shown:
    """Return a table of one row, and the same as JSON."""
    costs = run.table(READINGS)["cost_ns"].to_numpy(dtype="float64")
    found = summary_of(costs)
    header = ("cell", "n", f"{COST.title} ({COST.unit}), median")
    row = ("monotonic", str(len(costs)), number(found.median) if found else ABSENT)
    cell = {"cell": "monotonic", "n": len(costs), **summaries([("cost", costs)])}
    return Shown(
        tables={"readings": TextTable("toy-clock", header, [row], 1)},
        main=["readings"],
        json=lambda: frame(run, [cell], []),
        lanes=lanes(costs[:20] / 1e9),
    )


def lanes(costs_s: Any) -> Lanes:
    """Return one lane: readings end to end."""
    ends_s = costs_s.cumsum()
    texts = [f"reading {place}: {cost_s * 1e9:.0f} ns" for place, cost_s in enumerate(costs_s)]
    bars = [LaneBar("skill", *bar) for bar in zip(ends_s - costs_s, costs_s, texts, strict=True)]
    lane = Lane("monotonic", "#0072B2", bars, 0.0, f"{len(bars)} readings")
    return Lanes([LanePanel("readings of the clock", ends_s[-1], [lane])], "Bars are readings, end to end.")
