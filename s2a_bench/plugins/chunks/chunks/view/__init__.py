"""The sentences, tables, figures and JSON of a run of chunks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown
from s2a_bench.plugins.chunks.chunks.view.figures import chunk_figures, lanes_of
from s2a_bench.plugins.chunks.chunks.view.lanes import page_lanes
from s2a_bench.plugins.chunks.chunks.view.tables import (
    Row,
    chunk_csv,
    chunk_json,
    chunk_tables,
    entry,
    live,
    rows_of,
    sources_of,
)
from s2a_bench.writers.tables import number

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun


def show(run: StoredRun, **_: Any) -> Shown:
    return Shown.build(
        sentences=lambda: chunk_sentences(run),
        tables=chunk_tables(run),
        main=["chunks", "loop"],
        csvs=lambda: chunk_csv(run),
        figures=lambda: chunk_figures(run),
        json=lambda: chunk_json(run),
        lanes=lambda: page_lanes(lanes_of(run)),
    )


def chunk_sentences(run: StoredRun) -> list[str]:
    """Return each rule's stalled cycles, a live loop's agreement and jitter, and the slow-down that queue needs."""
    sentences = []
    epsilon = float(run.manifest["configuration"]["epsilon"])
    for name, rows in sources_of(rows_of(run)):
        by_rule = {row["rule"]: row for row in rows if row["p_stall_cycle"] is not None}
        stalls = [
            f"{rule} {row['p_stall_cycle']:.2%} at age {entry(row['age_ticks_mean'])}"
            for rule, row in by_rule.items()
            if rule != "given"
        ]
        if stalls:
            sentences.append(f"Stalled cycles of queue @ {name}, epsilon {epsilon:g}: {', '.join(stalls)} ticks.")
        if live(run):
            sentences.append(f"Control loop @ {name}: {'; '.join(_loop(rows))}.")
        slower = max((row["slow_down"] or 1 for row in rows if row["mode"].startswith("queue")), default=1)
        if slower > 1:
            sentences.append(
                f"@ {name} no trigger of queue is enough: actions would have to be {slower:.2f} times slower."
            )
    return sentences


def _loop(rows: list[Row]) -> Iterator[str]:
    """Yield what the ticks of a live loop were checked against, what was not checked, and the jitter."""
    checked = [row["agreement"] for row in rows if row["agreement"] is not None]
    if checked:
        rules = " and the triggers of their rules" if any(row["rule"] != "given" for row in rows) else ""
        yield (
            f"at least {min(checked):.2%} of the ticks have the chunk, the action and the age that the modes' arrays "
            f"give for the measured delays{rules}"
        )
    if unchecked := dict.fromkeys(row["mode"] for row in rows if row["agreement"] is None):
        yield f"not checked, as arrays do not cover its arrivals: {', '.join(unchecked)}"
    yield f"p99 of the jitter at most {number(max(row['jitter_s_p99'] for row in rows) * 1e3)} ms"
