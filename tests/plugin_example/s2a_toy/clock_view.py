"""How a run of `toy-clock` is shown: its metric, as a table, as JSON, in comparisons, and lanes on the page."""

from __future__ import annotations

from typing import Any

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells, Comparable
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.json import frame
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes
from s2a_toy.clock_run import READINGS

COMPARED = Comparable.of(READINGS, ("cost",))


def show(run: StoredRun, **_: Any) -> Shown:
    """Return a table of one row, and the same as JSON."""
    cells = Cells.of(run, READINGS)
    return Shown.build(
        tables={"readings": lambda: cells.table("toy-clock")},
        main=["readings"],
        json=lambda: frame(run, cells.json(), []),
        lanes=lambda: lanes(cells.values("cost")[:20] / 1e9),
    )


def lanes(costs_s: Any) -> Lanes:
    """Return one lane: readings end to end."""
    ends_s = costs_s.cumsum()
    texts = [f"reading {place}: {cost_s * 1e9:.0f} ns" for place, cost_s in enumerate(costs_s)]
    bars = [LaneBar("skill", *bar) for bar in zip(ends_s - costs_s, costs_s, texts, strict=True)]
    lane = Lane("monotonic", "#0072B2", bars, 0.0, f"{len(bars)} readings")
    return Lanes([LanePanel("readings of the clock", ends_s[-1], [lane])], "Bars are readings, end to end.")
