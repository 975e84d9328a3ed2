"""The figures of a run of chunks: lanes of control ticks, stalls and smoothness over latency, triggers, reactions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.plugins.chunks.chunks.rows import MEANS, REACTIONS, REQUESTS, TICKS, TRIGGERS, ChunkRow
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
STALLS: Final = {"stall_share": "stalled share"}
SMOOTHNESS: Final = {"tracking_rms": "tracking error (sd)", "jerk_rms": "jerk (sd/s$^3$)"}
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
    ticks: pd.DataFrame
    requests: pd.DataFrame
    period_s: float


def lanes_of(run: StoredRun, cells: ChunkCells) -> list[CellTicks]:
    """Return the lanes of a run: the modes as given, and the calibrated trigger."""
    ticks, requests = run.table(TICKS), run.table(REQUESTS)
    shown = int(cells.settings["shown_ticks"])
    ticks, requests = ticks[ticks["tick"] < shown], requests[requests["request_tick"] < shown]
    lanes = []
    for row in filter(_drawn, cells.rows):
        mine, sent = ticks[ticks["cell"] == row.cell], requests[requests["cell"] == row.cell]
        if len(mine):
            lanes.append(CellTicks(_line_name(row), row.latency, mine, sent, row.delta_t_s))
    return lanes[:MOST_LANES]


def build_lanes(lanes: Sequence[CellTicks], setting: str) -> Figure:
    """Draw the lanes below one another: actions coloured by chunk, stalls hatched, requests above, ages below."""
    from matplotlib.legend_handler import HandlerTuple

    several = len({lane.source for lane in lanes}) > 1
    source = "" if several else f" @ {lanes[0].source}"
    caption = (f"What each control tick executes{source}, {setting}",)
    figure = new_figure(0.85 + 0.55 * len(lanes), caption, WIDE_IN)
    axes = figure.subplots()
    oldest = max(int(lane.ticks["age_ticks"].fillna(0).max()) for lane in lanes) or 1
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
    chunk = lane.ticks["chunk"].fillna(-1).to_numpy(dtype="int64")
    stalled = lane.ticks["stalled"].to_numpy(dtype="bool")
    for first, last in runs_of(np.where(stalled, -2, chunk)):
        width = last - first
        if stalled[first]:
            axes.broken_barh([(first, width)], (top, _BAR), **STALL_STYLE)
        elif chunk[first] >= 0:
            axes.broken_barh([(first, width)], (top, _BAR), color=COLOURS[chunk[first] % len(COLOURS)], linewidth=0)
    for row in lane.requests.to_dict("records"):
        leaves, usable = row["request_tick"], row["request_tick"] + row["delay_ticks"]
        axes.hlines(top - 0.07, leaves, usable, "#666666", linewidth=0.7)
        axes.plot([leaves], [top - 0.07], "|", color="#666666", markersize=3, markeredgewidth=0.7)
        if row["thrown_away"] and row["executed"] and row["start_tick"] + row["executed"] < len(chunk):
            end = row["start_tick"] + row["executed"]
            ink = ink_on(COLOURS[chunk[end - 1] % len(COLOURS)])
            text = f"\N{MINUS SIGN}{row['thrown_away']}"
            axes.annotate(text, (end, place), ha="right", va="center", fontsize=5, color=ink)
    age = lane.ticks["age_ticks"].to_numpy(dtype="float64", na_value=np.nan)
    axes.step(
        np.arange(age.size + 1),
        _age_at(place, np.append(age, age[-1]) / oldest),
        where="post",
        color="#D55E00",
        linewidth=0.7,
    )


def _age_at(place: float, share: Any) -> Any:
    return place + _BAR / 2 + 0.03 + _AGE * share


def runs_of(values: np.ndarray) -> list[tuple[int, int]]:
    """Return the half-open ranges of equal values."""
    edges = np.flatnonzero(np.diff(values)) + 1
    bounds = [0, *edges.tolist(), values.size]
    return list(pairwise(bounds))


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
    means, triggers, reactions = run.table(MEANS), run.table(TRIGGERS), run.table(REACTIONS)
    settings = cells.settings
    setting = f"H = {settings['horizon']}, {settings['control_hz']:g} Hz, d by {settings['rounding']}"
    figures: dict[str, Callable[[], Figure]] = {}
    if lanes:
        figures["lanes"] = partial(build_lanes, lanes, setting)
    if len(means):
        figures["stability"] = partial(build_over_means, means, f"Stalled share of the ticks, {setting}", STALLS)
    if len(triggers):
        figures["triggers"] = partial(build_triggers, triggers, cells.sources, float(settings["epsilon"]), setting)
    if len(reactions):
        figures["reactions"] = partial(build_reactions, reactions, cells.sources, setting)
    if means["tracking_rms"].notna().any():
        figures["smoothness"] = partial(build_over_means, means, f"Following a target, {setting}", SMOOTHNESS)
    return figures


def build_over_means(rows: pd.DataFrame, title: str, shown: Mapping[str, str]) -> Figure:
    """Draw columns over mean latency, a panel each, a line a mode; dashed: a request in every tick, no latency."""
    modes = [str(mode) for mode in rows["mode"].unique()][: len(LINE_COLOURS)]
    columns = 2 if max(map(len, modes)) <= LINE_CHARS // 3 else 1
    foot_in = 0.17 * -(-(len(modes) + 1) // columns)
    caption = (title, f"Latencies are those of {rows['latency'].iloc[0]}, all scaled by one factor.")
    figure = new_figure(0.8 + 1.3 * len(shown) + foot_in, caption)
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    latency_ms = rows["latency_s"].to_numpy(dtype="float64") * 1e3
    for axes, (name, label) in zip(panels, shown.items(), strict=True):
        values = rows[name].to_numpy(dtype="float64", na_value=np.nan)
        for mode, colour in zip(modes, LINE_COLOURS, strict=False):
            mine = (rows["mode"] == mode).to_numpy()
            axes.plot(latency_ms[mine], values[mine], color=colour, label=short(mode, LINE_CHARS - 8))
        if f"{name}_ideal" in rows:
            ideal = rows.groupby("latency_s")[f"{name}_ideal"].mean().to_numpy(dtype="float64")
            axes.plot(np.unique(latency_ms), ideal, "--", color="black", label="a request in every tick, no latency")
        axes.set_ylim(bottom=0)
        axes.ticklabel_format(axis="y", scilimits=(-3, 5))
        axes.set_ylabel(label)
    panels[-1].set_xlim(0, float(latency_ms.max()))
    panels[-1].set_xlabel("mean latency, L (ms)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns, columnspacing=1.0)
    return figure


def build_triggers(
    rows: pd.DataFrame, sources: Mapping[str, Sequence[ChunkRow]], epsilon: float, setting: str
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
    floor = min(epsilon, 1 / max(int(rows["boundaries"].max()), 1)) / 2
    for place, (name, cells) in enumerate(groups):
        colour = LINE_COLOURS[place % len(LINE_COLOURS)]
        mine = rows[rows["latency"] == name]
        with_form = mine[mine["p_stall_closed"].notna()]
        closed = np.maximum(with_form["p_stall_closed"].to_numpy(dtype="float64"), floor)
        axes.plot(with_form["trigger"].to_numpy(dtype="float64"), closed, color=colour, linewidth=0.9)
        label = short(name, LINE_CHARS - 8)
        lines += axes.plot([], [], color=colour, label=label)
        share = mine["p_stall_cycle"].to_numpy(dtype="float64")
        above = share - mine["p_stall_low"].to_numpy(dtype="float64")
        below = mine["p_stall_high"].to_numpy(dtype="float64") - share
        axes.errorbar(
            mine["trigger"].to_numpy(dtype="float64"),
            np.maximum(share, floor),
            [np.maximum(above, 0), np.maximum(below, 0)],
            fmt=".",
            color=colour,
            markersize=3,
            elinewidth=0.5,
        )
        for rule, marker in _RULES.items():
            for cell in cells:
                if cell.rule == rule and cell.trigger is not None:
                    at = max(cell.p_stall_cycle or 0.0, floor)
                    axes.plot(cell.trigger, at, marker, color=colour, markerfacecolor="none", markersize=7)
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
