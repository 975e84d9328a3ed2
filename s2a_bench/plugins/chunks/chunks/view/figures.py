"""The figures of a run of chunks: lanes of control ticks, stalls over latency, triggers, reactions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.chunks.chunks.rows import (
    MEANS,
    REACTIONS,
    REQUESTS,
    TICKS,
    TRIGGERS,
    ChunkRow,
    RequestRow,
    TickRow,
    TriggerRow,
)
from s2a_bench.plugins.chunks.chunks.view.tables import ChunkCells
from s2a_bench.writers.figures import LINE_CHARS, new_figure
from s2a_bench.writers.style import STALL_STYLE, WIDE_IN, ink_on

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

MOST_LANES: Final = 12
"""More are not legible; chunk_ticks.csv has all."""
COLOURS: Final = ("#0072B2", "#56B4E9", "#009E73")
_BAR: Final = 0.34
_AGE: Final = 0.42
LINE_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
_RULES: Final = {"calibrated": "o", "tracked": "s", "maximum": "^", "mean": "v", "oracle": "*"}
_INK: Final = "#222222"
_MOST_PANELS: Final = 8
_BULK: Final = 0.9975
"""Quantile where the axis of reaction times ends; chunk_reactions.csv has the rest."""


@dataclass(frozen=True, slots=True)
class CellTicks:
    """The first ticks of one cell, and their requests."""

    title: str
    source: str
    ticks: list[TickRow]
    requests: list[RequestRow]
    period_s: float

    def stretches(self) -> Iterator[list[TickRow]]:
        """Yield the ticks with actions of one chunk, and those of one stall, in their order."""
        for (stalled, chunk), ticks in groupby(self.ticks, lambda tick: (tick.stalled, tick.chunk)):
            if stalled or chunk is not None:
                yield list(ticks)


def lanes_of(run: StoredRun, cells: ChunkCells) -> list[CellTicks]:
    """Return the lanes of a run: the modes as given, and the calibrated trigger."""
    ticks, requests = Cells.of(run, TICKS), Cells.of(run, REQUESTS)
    shown = int(cells.settings["shown_ticks"])
    ticks = replace(ticks, frame=ticks.frame[ticks.frame["tick"] < shown])
    requests = replace(requests, frame=requests.frame[requests.frame["request_tick"] < shown])
    lanes = []
    for row in filter(_drawn, cells.rows):
        mine, sent = ticks.where(cell=row.cell), requests.where(cell=row.cell)
        if len(mine):
            lanes.append(CellTicks(_line_name(row), row.latency, mine.rows, sent.rows, row.delta_t_s))
    return lanes[:MOST_LANES]


def build_lanes(lanes: Sequence[CellTicks], setting: str) -> Figure:
    """Draw the lanes below one another: actions coloured by chunk, stalls hatched, requests above, ages below."""
    from matplotlib.legend_handler import HandlerTuple

    several = len({lane.source for lane in lanes}) > 1
    source = "" if several else f" @ {lanes[0].source}"
    caption = (f"What each control tick executes{source}, {setting}",)
    figure = new_figure(0.85 + 0.55 * len(lanes), caption, WIDE_IN)
    axes = figure.subplots()
    oldest = max(tick.age_ticks or 0 for lane in lanes for tick in lane.ticks) or 1
    for place, lane in enumerate(lanes):
        _draw_lane(axes, lane, place, oldest)
    axes.set_yticks(range(len(lanes)), [_label(lane, several=several) for lane in lanes])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(lanes) - 0.33, -0.6)
    axes.set_xlim(0, max(len(lane.ticks) for lane in lanes))
    axes.set_xlabel("control tick")
    ages = axes.secondary_yaxis("right")
    bounds = [_age_at(place, age) for place in range(len(lanes)) for age in (0, 1)]
    ages.set_yticks(bounds, ["0", str(oldest)] * len(lanes), fontsize=5)
    ages.set_ylabel("age (ticks)")
    legend = _legend()
    figure.legend(
        legend.values(),
        legend.keys(),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0)},
        loc="outside lower center",
        ncols=5,
        columnspacing=1.0,
    )
    return figure


def _draw_lane(axes: Axes, lane: CellTicks, place: int, oldest: int) -> None:
    """Draw one lane around y = ``place``; the curve of ages below it reaches the next lane at age ``oldest``."""
    top = place - _BAR / 2
    for stretch in lane.stretches():
        colours = STALL_STYLE if stretch[0].stalled else {"color": colour_of(stretch[0].chunk), "linewidth": 0}
        axes.broken_barh([(stretch[0].tick, len(stretch))], (top, _BAR), **colours)
    for request in lane.requests:
        leaves, usable = request.request_tick, request.request_tick + request.delay_ticks
        axes.hlines(top - 0.07, leaves, usable, "#666666", linewidth=0.7)
        axes.plot([leaves], [top - 0.07], "|", color="#666666", markersize=3, markeredgewidth=0.7)
        end = (request.start_tick or 0) + request.executed
        if request.thrown_away and request.executed and end < len(lane.ticks):
            ink, text = ink_on(colour_of(request.request)), f"\N{MINUS SIGN}{request.thrown_away}"
            axes.annotate(text, (end, place), ha="right", va="center", fontsize=5, color=ink)
    age = np.array([tick.age_ticks for tick in lane.ticks], dtype="float64")
    axes.step(
        np.arange(age.size + 1),
        _age_at(place, np.append(age, age[-1]) / oldest),
        where="post",
        color="#D55E00",
        linewidth=0.7,
    )


def _age_at(place: float, share: Any) -> Any:
    return place + _BAR / 2 + 0.03 + _AGE * share


def colour_of(chunk: int | None) -> str:
    return COLOURS[(chunk or 0) % len(COLOURS)]


def _label(lane: CellTicks, *, several: bool) -> str:
    lines = [lane.title, lane.source] if several else [lane.title]
    return "\n".join(short(line, 30) for line in lines)


def short(text: str, most: int) -> str:
    """Return a text cut to ``most`` characters; `textwrap.shorten` would drop a single long word."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _legend() -> dict[str, Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return {
        "actions, a colour a chunk": tuple(Patch(color=colour) for colour in COLOURS),
        "k of its actions thrown away": Line2D([], [], color=_INK, linestyle="", marker="$-k$", markersize=8),
        "stall": Patch(**STALL_STYLE),
        "request to usable chunk": Line2D([], [], color="#666666", linewidth=0.7, marker="|", markersize=3),
        "age of the observation": Line2D([], [], color="#D55E00", linewidth=0.7),
    }


def chunk_figures(run: StoredRun, cells: ChunkCells, lanes: Sequence[CellTicks]) -> dict[str, Callable[[], Figure]]:
    means, triggers, reactions = run.table(MEANS), Cells.of(run, TRIGGERS).rows, run.table(REACTIONS)
    settings = cells.settings
    setting = f"H = {settings['horizon']}, {settings['control_hz']:g} Hz, d by {settings['rounding']}"
    figures: dict[str, Callable[[], Figure]] = {}
    if lanes:
        figures["lanes"] = partial(build_lanes, lanes, setting)
    if len(means):
        figures["stability"] = partial(build_stability, means, setting)
    if triggers:
        figures["triggers"] = partial(build_triggers, triggers, cells.sources, float(settings["epsilon"]), setting)
    if len(reactions):
        figures["reactions"] = partial(build_reactions, reactions, cells.sources, setting)
    return figures


def build_stability(rows: pd.DataFrame, setting: str) -> Figure:
    """Draw the stalled share over mean latency, a line a mode."""
    modes = [str(mode) for mode in rows["mode"].unique()][: len(LINE_COLOURS)]
    columns = 2 if max(map(len, modes)) <= LINE_CHARS // 3 else 1
    more = f"Latencies are those of {rows['latency'].iloc[0]}, all scaled by one factor."
    figure = new_figure(2.1 + 0.17 * -(-len(modes) // columns), (f"Stalled share of the ticks, {setting}", more))
    axes = figure.subplots()
    latency_ms = rows["latency_s"].to_numpy(dtype="float64") * 1e3
    share = rows["stall_share"].to_numpy(dtype="float64", na_value=np.nan)
    for mode, colour in zip(modes, LINE_COLOURS, strict=False):
        mine = (rows["mode"] == mode).to_numpy()
        axes.plot(latency_ms[mine], share[mine], color=colour, label=short(mode, LINE_CHARS - 8))
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, float(latency_ms.max()))
    axes.set_ylabel("stalled share")
    axes.set_xlabel("mean latency, L (ms)")
    figure.legend(loc="outside lower center", ncols=columns, columnspacing=1.0)
    return figure


def build_triggers(
    rows: Sequence[TriggerRow], sources: Mapping[str, Sequence[ChunkRow]], epsilon: float, setting: str
) -> Figure:
    """Draw P(stall) over the trigger with its closed form, a line a source, and the trigger of each rule."""
    groups = list(sources.items())[:_MOST_PANELS]
    more = (
        "Line: closed form of the same sample of latencies; dots: simulated, with 95 % intervals; 0 lies at the bottom."
    )
    figure = new_figure(2.5 + 0.16 * len(groups), (f"P(stall) against the trigger of queue, {setting}", more))
    axes = figure.subplots()
    lines: list[Any] = []
    rules: list[Any] = []
    floor = min(epsilon, 1 / max(row.boundaries for row in rows)) / 2
    for place, (name, cells) in enumerate(groups):
        colour = LINE_COLOURS[place % len(LINE_COLOURS)]
        mine = [row for row in rows if row.latency == name]
        closed = [(row.trigger, max(row.p_stall_closed, floor)) for row in mine if row.p_stall_closed is not None]
        axes.plot(*np.array(closed).reshape(-1, 2).T, color=colour, linewidth=0.9)
        lines += axes.plot([], [], color=colour, label=short(name, LINE_CHARS - 8))
        shares = np.array([(row.p_stall_cycle, row.p_stall_low, row.p_stall_high) for row in mine])
        share, low, high = shares.reshape(-1, 3).T
        ends, at = np.maximum([share - low, high - share], 0), [row.trigger for row in mine]
        axes.errorbar(at, np.maximum(share, floor), ends, fmt=".", color=colour, markersize=3, elinewidth=0.5)
        for rule, marker in _RULES.items():
            for cell in cells:
                if cell.rule == rule and cell.trigger is not None:
                    stalled = max(cell.p_stall_cycle or 0.0, floor)
                    axes.plot(cell.trigger, stalled, marker, color=colour, markerfacecolor="none", markersize=7)
    for rule, marker in _RULES.items():
        if any(cell.rule == rule for _, cells in groups for cell in cells):
            style: dict[str, Any] = {"markerfacecolor": "none", "markersize": 6, "linestyle": "none"}
            rules += axes.plot([], [], marker, color=_INK, label=rule, **style)
    axes.axhline(epsilon, color=_INK, linestyle=":", linewidth=0.8)
    axes.text(0.01, epsilon, f"epsilon = {epsilon:.3g}", transform=axes.get_yaxis_transform(), va="bottom")
    axes.set_yscale("log")
    axes.set_ylim(floor * 0.8, 1.3)
    axes.set_xlabel("trigger, m (actions left at the request)")
    axes.set_ylabel("P(stall) a cycle")
    axes.legend(handles=rules, loc="upper right", ncols=2, columnspacing=1.0)
    figure.legend(handles=lines, loc="outside lower center")
    return figure


def build_reactions(rows: pd.DataFrame, sources: Mapping[str, Sequence[ChunkRow]], setting: str) -> Figure:
    """Draw the distribution of reaction times, a panel a source and a line a mode; dotted: the closed form."""
    groups = list(sources.items())[:_MOST_PANELS]
    names = list(dict.fromkeys(_line_name(cell) for _, cells in groups for cell in cells if _drawn(cell)))
    what = "From an event to the first tick that knows of it; the last 0.25 % of the slowest mode are beyond the axis."
    foot_in = 0.17 * -(-(len(names) + 1) // 2)
    figure = new_figure(0.5 + foot_in + 1.6 * len(groups), (f"Reaction times, {setting}", what))
    panels = figure.subplots(len(groups), 1, squeeze=False)[:, 0]
    for axes, (source, cells) in zip(panels, groups, strict=True):
        for cell in filter(_drawn, cells):
            mine = rows[rows["cell"] == cell.cell]
            with_form = mine[mine["closed_s"].notna()]
            colour = LINE_COLOURS[names.index(_line_name(cell)) % len(LINE_COLOURS)]
            axes.step(mine["reaction_s"] * 1e3, mine["share"], where="post", color=colour)
            axes.plot(with_form["closed_s"] * 1e3, with_form["share"], ":", color="black", linewidth=0.8)
        axes.set_title(short(source, LINE_CHARS), loc="left", pad=2)
        axes.set_ylim(0, 1)
        shown = rows[rows["cell"].isin([cell.cell for cell in cells if _drawn(cell)]) & (rows["share"] <= _BULK)]
        axes.set_xlim(0, float(shown["reaction_s"].max()) * 1e3)
        axes.set_ylabel("share")
    panels[-1].set_xlabel("reaction time (ms)")
    handles: list[Any] = [
        panels[-1].plot([], [], color=LINE_COLOURS[place % len(LINE_COLOURS)], label=name)[0]
        for place, name in enumerate(names)
    ]
    handles += panels[-1].plot([], [], ":", color="black", label="closed form of the same sample")
    figure.legend(handles=handles, loc="outside lower center", ncols=2, columnspacing=1.0)
    return figure


def _drawn(row: ChunkRow) -> bool:
    return row.rule in {"given", "calibrated"}


def _line_name(row: ChunkRow) -> str:
    return row.mode if row.rule == "given" else f"{row.mode}, {row.rule}"
