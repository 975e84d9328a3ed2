"""What a latency run says in a few sentences: what was measured, how often, and what came out, with its interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import asked, cells_of, ratios
from s2a_bench.experiments.latency.view.tables import TITLES
from s2a_bench.stats import summary_of
from s2a_bench.transport import declared
from s2a_bench.writers.tables import interval, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2a_bench.stats import Ratio
    from s2a_bench.store.run import Run

_MOST = 6
"""Sentences of one kind; the tables have the rest."""


def latency_sentences(run: Run) -> list[str]:
    """Return how long each cell takes, and how many times as long as ROS or loopback."""
    if not (cells := cells_of(run)):
        return []
    about = cells[0].about
    names = ", ".join(cell.name for cell in cells)
    requests = counts([cell.n for cell in cells], "request")
    said = [f"{requests} a cell over {names}; frames of {asked(run, cells)}, {about['mode']} mode."]
    comparable = any(cell.values_ms("e2e_without_inference").size for cell in cells)
    metric = "e2e_without_inference" if comparable else "e2e"
    medians = [
        f"{cell.name} {number(middle.median)} ms" for cell in cells if (middle := summary_of(cell.values_ms(metric)))
    ]
    if medians:
        said.append(f"{TITLES[metric]}, medians: {', '.join(medians)}.")
    found = [
        _times(cell.name, base.name, ratio)
        for of, cell, base, ratio in ratios(cells, run.bootstrap_seed)
        if of == metric and not declared(base.pipeline).in_process
    ]
    beside = [
        f"Without model, {_times(cell.name, base.name, ratio)}"
        for of, cell, base, ratio in ratios(cells, run.bootstrap_seed)
        if of == "e2e_without_model" and cell.has_ingest and not declared(base.pipeline).in_process
    ]
    return said + found[:_MOST] + beside[:_MOST]


def counts(counts: Sequence[int], what: str) -> str:
    """Return how many there are: 50 requests, or 48 to 50."""
    low, high = min(counts), max(counts)
    span = str(low) if low == high else f"{low} to {high}"
    return f"{span} {what}{'s' * (high != 1)}"


def _times(cell: str, base: str, ratio: Ratio) -> str:
    """Return how many times as long as a base a cell takes."""
    between = ""
    if ratio.low is not None and ratio.high is not None:
        over = f"over {ratio.launches} launches" if ratio.launches > 1 else "of one launch"
        bounds = interval(ratio).partition(" ")[2][1:-1].replace(",", " to")
        between = f" (ratio of medians {over}, 95 % interval {bounds})"
    value = "an unknown number of" if ratio.value is None else number(ratio.value)
    return f"{cell} takes {value} times as long as {base}{between}."
