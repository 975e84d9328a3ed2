"""The first control ticks of a run as lanes of the page: a panel a source of latencies, a lane a mode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from s2a_bench.plugins.chunks.chunks.view.figures import COLOURS, CellTicks, runs_of
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes

BARS: Final = "Bars are actions, a colour a chunk; dashed boxes are stalls. Time counts from the first request."


def page_lanes(cells: Sequence[CellTicks]) -> Lanes:
    """Return the lanes of every mode, in seconds from the first request."""
    groups: dict[str, list[CellTicks]] = {}
    for cell in cells:
        groups.setdefault(cell.source, []).append(cell)
    panels = []
    for source, group in groups.items():
        end_s = max(len(cell.ticks) * cell.period_s for cell in group)
        panels.append(LanePanel(f"Latency {source}", end_s, [_lane(cell) for cell in group]))
    return Lanes(panels, BARS)


def _lane(cell: CellTicks) -> Lane:
    bars = tuple(_bars(cell))
    stalled = int(cell.ticks["stalled"].sum())
    begin = next((bar.start_s for bar in bars), 0.0)
    summary = f"{stalled} of the first {len(cell.ticks)} ticks stall" if stalled else "no stall"
    return Lane(cell.title, COLOURS[0], bars, begin, summary)


def _bars(cell: CellTicks) -> Iterator[LaneBar]:
    """Yield a bar for every stretch of actions of one chunk, and for every stall."""
    chunk = cell.ticks["chunk"].fillna(-1).to_numpy(dtype="int64")
    index = cell.ticks["index"].fillna(-1).to_numpy(dtype="int64")
    age = cell.ticks["age_ticks"].fillna(-1).to_numpy(dtype="int64")
    stalled = cell.ticks["stalled"].to_numpy(dtype="bool")
    unused = dict(zip(cell.requests["request"], cell.requests["thrown_away"], strict=True))
    for first, last in runs_of(np.where(stalled, -2, chunk)):
        span = f"ticks {first} to {last - 1}"
        start_s, width_s = first * cell.period_s, (last - first) * cell.period_s
        if stalled[first]:
            yield LaneBar("stall", start_s, width_s, f"{cell.title}: stall of {last - first} ticks, {span}")
        elif chunk[first] >= 0:
            text = (
                f"{cell.title}: chunk {chunk[first]}, actions {index[first]} to {index[last - 1]}, {span}, "
                f"observation {age[first]} to {age[last - 1]} ticks old"
            )
            away = f", {unused[chunk[first]]} actions thrown away" if unused.get(chunk[first]) else ""
            yield LaneBar("skill", start_s, width_s, text + away, COLOURS[chunk[first] % len(COLOURS)])
