"""The page's timelines of plans and control ticks of chunks: panels of lanes of bars, in seconds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from s2a_bench.experiments.chunks.view.figures import COLOURS, runs_of
from s2a_bench.experiments.chunks.view.figures import CellTicks as ChunkLane
from s2a_bench.experiments.timeline.view.cells import Timelines, panels
from s2a_bench.experiments.timeline.view.figures import policy_colours
from s2a_bench.experiments.timeline.view.tables import seconds

MOST_PANELS = 60
"""Limit on the size of the page; the tables and CSV files have all."""
TICKS = 6


@dataclass(frozen=True, slots=True)
class Segment:
    """One skill, chunk or stall; ``text`` describes it, ``colour`` replaces that of the lane."""

    kind: str
    start_s: float
    width_s: float
    text: str
    colour: str = ""


@dataclass(frozen=True, slots=True)
class PolicyRow:
    """One policy's plan: its bars, S0 if it has one, and its tokens if lanes do not share them."""

    name: str
    colour: str
    bars: tuple[Segment, ...]
    start_s: float
    safe_start_s: float | None
    tokens_s: tuple[float, ...]
    complete_s: tuple[float, ...]
    summary: str


@dataclass(frozen=True, slots=True)
class BoardPanel:
    """One board and granularity; ``tokens_s`` and ``complete_s`` are empty if lanes do not share them."""

    title: str
    end_s: float
    ticks: tuple[float, ...]
    lanes: tuple[PolicyRow, ...]
    tokens_s: tuple[float, ...]
    complete_s: tuple[float, ...]


def panels_of(cells: Sequence[Timelines]) -> list[BoardPanel]:
    colours = policy_colours(list(dict.fromkeys(cell.policy for cell in cells)))
    return [_panel(setting, group, colours) for setting, group in list(panels(cells))[:MOST_PANELS]]


def _panel(setting: tuple[str, int, int, float], cells: Sequence[Timelines], colours: dict[str, str]) -> BoardPanel:
    title, tokens, n_skills, t_nom_s = setting
    shared = len({cell.about("request_id") for cell in cells}) == 1
    end_s = max(cell.moment_s("end_s") for cell in cells) * 1.02
    rate = f"{cells[0].about('tokens_per_s'):g} tokens/s"
    board = title if rate in title else f"{title}, {rate}"
    plans = f"; plan 1 of {cells[0].n}" if cells[0].n > 1 else ""
    return BoardPanel(
        f"{board}: L = {tokens}, N = {n_skills}, T_nom = {t_nom_s:g} s{plans}",
        end_s,
        ticks_of(end_s),
        tuple(_lane(cell, colours[cell.policy], own_tokens=not shared) for cell in cells),
        tuple(cells[0].token_s) if shared else (),
        _complete_s(cells[0]) if shared else (),
    )


def ticks_of(end_s: float) -> tuple[float, ...]:
    """Return round times from 0 to the end."""
    step = next(
        each
        for power in range(-6, 12)
        for each in (1 * 10.0**power, 2 * 10.0**power, 5 * 10.0**power)
        if end_s <= TICKS * each
    )
    return tuple(place * step for place in range(int(end_s / step) + 1))


def _lane(cell: Timelines, colour: str, *, own_tokens: bool) -> PolicyRow:
    bars = []
    for skill in cell.skills.to_dict("records"):
        start, end, stall, arrival = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall", "arrival"))
        name = f"skill {skill['index'] + 1}" + (f" {skill['text']}" if skill["text"] else "")
        if stall > 0:
            span = f"{seconds(start - stall)} to {seconds(start)} s"
            text = f"{cell.policy}: stall of {seconds(stall)} s before {name}, {span}"
            bars.append(Segment("stall", start - stall, stall, text))
        stalled = f", after a stall of {seconds(stall)} s" if stall > 0 else ", no stall before it"
        text = (
            f"{cell.policy}: {name} arrives at {seconds(arrival)} s, runs {seconds(start)} to {seconds(end)} s{stalled}"
        )
        bars.append(Segment("skill", start, end - start, text))
    stalls, stall_s = int(cell.rows["stalls"].iloc[0]), cell.moment_s("stall_s")
    summary = f"starts {seconds(cell.moment_s('start_s'))} s, ends {seconds(cell.moment_s('end_s'))} s, "
    summary += f"{stalls} stalls, {seconds(stall_s)} s" if stall_s else "no stalls"
    return PolicyRow(
        cell.policy,
        colour,
        tuple(bars),
        cell.moment_s("start_s"),
        cell.moment_s("safe_start_s"),
        tuple(cell.token_s) if own_tokens else (),
        _complete_s(cell) if own_tokens else (),
        summary,
    )


def _complete_s(cell: Timelines) -> tuple[float, ...]:
    return tuple(cell.skills["arrival_ns"].to_numpy(dtype="float64") / 1e9)


def panels_of_chunks(lanes: Sequence[ChunkLane]) -> list[BoardPanel]:
    """Return the panels of the first ticks of every mode, in seconds from the first request."""
    groups: dict[str, list[ChunkLane]] = {}
    for lane in lanes:
        groups.setdefault(lane.source, []).append(lane)
    panels = []
    for source, group in groups.items():
        end_s = max(len(lane.ticks) * lane.period_s for lane in group)
        panels.append(BoardPanel(f"Latency {source}", end_s, ticks_of(end_s), tuple(map(_chunk_lane, group)), (), ()))
    return panels


def _chunk_lane(lane: ChunkLane) -> PolicyRow:
    bars = tuple(_chunk_bars(lane))
    stalled = int(lane.ticks["stalled"].sum())
    begin = next((bar.start_s for bar in bars), 0.0)
    summary = f"{stalled} of the first {len(lane.ticks)} ticks stall" if stalled else "no stall"
    return PolicyRow(lane.title, COLOURS[0], bars, begin, None, (), (), summary)


def _chunk_bars(lane: ChunkLane) -> Iterator[Segment]:
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
            yield Segment("stall", start_s, width_s, f"{lane.title}: stall of {last - first} ticks, {span}")
        elif chunk[first] >= 0:
            text = (
                f"{lane.title}: chunk {chunk[first]}, actions {index[first]} to {index[last - 1]}, {span}, "
                f"observation {age[first]} to {age[last - 1]} ticks old"
            )
            away = f", {unused[chunk[first]]} actions thrown away" if unused.get(chunk[first]) else ""
            yield Segment("skill", start_s, width_s, text + away, COLOURS[chunk[first] % len(COLOURS)])
