"""Control ticks of chunks as what the page draws: a panel a source of latencies, a lane a mode, a bar a chunk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from s2a_bench.experiments.chunks.view.lanes import COLOURS, Lane, runs_of
from s2a_bench.report.page import lanes as page


def panels_of_chunks(lanes: Sequence[Lane]) -> list[page.Panel]:
    """Lay out the first ticks of every mode, in seconds from the first request."""
    groups: dict[str, list[Lane]] = {}
    for lane in lanes:
        groups.setdefault(lane.source, []).append(lane)
    return [_panel(source, group) for source, group in groups.items()]


def _panel(source: str, lanes: Sequence[Lane]) -> page.Panel:
    end_s = max(len(lane.ticks) * lane.period_s for lane in lanes)
    return page.Panel(f"Latency {source}", end_s, page.ticks_of(end_s), tuple(map(_lane, lanes)), (), ())


def _lane(lane: Lane) -> page.Lane:
    bars = tuple(_bars(lane))
    stalled = int(lane.ticks["stalled"].sum())
    begin = next((bar.start_s for bar in bars), 0.0)
    words = f"{stalled} of the first {len(lane.ticks)} ticks stall" if stalled else "no stall"
    return page.Lane(lane.title, COLOURS[0], bars, begin, None, (), (), words)


def _bars(lane: Lane) -> Iterator[page.Bar]:
    """Yield a bar for every stretch of actions of one chunk, and for every stall."""
    chunk = lane.ticks["chunk"].fillna(-1).to_numpy(dtype="int64")
    index = lane.ticks["index"].fillna(-1).to_numpy(dtype="int64")
    age = lane.ticks["age_ticks"].fillna(-1).to_numpy(dtype="int64")
    stalled = lane.ticks["stalled"].to_numpy(dtype="bool")
    unused = dict(zip(lane.requests["request"], lane.requests["thrown_away"], strict=True))
    for first, last in runs_of(np.where(stalled, -2, chunk)):
        span = f"ticks {first} to {last - 1}"
        start_s, width_s = first * lane.period_s, (last - first) * lane.period_s
        if stalled[first]:
            yield page.Bar("stall", start_s, width_s, f"{lane.title}: stall of {last - first} ticks, {span}")
        elif chunk[first] >= 0:
            text = (
                f"{lane.title}: chunk {chunk[first]}, actions {index[first]} to {index[last - 1]}, {span}, "
                f"observation {age[first]} to {age[last - 1]} ticks old"
            )
            away = f", {unused[chunk[first]]} actions thrown away" if unused.get(chunk[first]) else ""
            yield page.Bar("skill", start_s, width_s, text + away, COLOURS[chunk[first] % len(COLOURS)])
