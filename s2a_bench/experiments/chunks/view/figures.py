"""The figures of a run of chunks: stability diagram, P(stall) against trigger, reactions; PNG and PDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.chunks.rows import REACTIONS, SMOOTHNESS, STABILITY, TRIGGERS
from s2a_bench.experiments.chunks.view.lanes import build_lanes, lanes_of, short
from s2a_bench.experiments.chunks.view.tables import rows_of, sources_of
from s2a_bench.writers.figures import LINE_CHARS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

LOOKS: Final = (
    ("#0072B2", "-", "o"),
    ("#D55E00", "-", "s"),
    ("#009E73", "-", "^"),
    ("#CC79A7", "-", "D"),
    ("#E69F00", "-", "v"),
    ("#56B4E9", "-", "P"),
    ("#000000", "-", "X"),
    ("#999999", "-", "*"),
)
"""Colour, line, marker: of modes, of sources."""
_RULES: Final = {"calibrated": "o", "tracked": "s", "maximum": "^", "mean": "v", "oracle": "*"}
_INK: Final = "#222222"
_MOST_PANELS: Final = 8
_BULK: Final = 0.985
"""The axis of reaction times ends a little behind this quantile; chunk_reactions.csv has the rest."""


def chunk_figures(run: Run) -> dict[str, Callable[[], Figure]]:
    """Return each figure that the run has rows for, by its file's name."""
    found: dict[str, Callable[[], Figure]] = {}
    if lanes_of(run):
        found["lanes"] = partial(build_lanes, run)
    if len(run.table(STABILITY)):
        found["stability"] = partial(build_stability, run)
    if len(run.table(TRIGGERS)):
        found["triggers"] = partial(build_triggers, run)
    if len(run.table(REACTIONS)):
        found["reactions"] = partial(build_reactions, run)
    if len(run.table(SMOOTHNESS)):
        from s2a_bench.experiments.chunks.view.smoothness import build_smoothness

        found["smoothness"] = partial(build_smoothness, run)
    return found


def build_stability(run: Run) -> Figure:
    """Draw the stalled share of the ticks over mean latency and execution horizon, with the line s = H - d.

    Beside it what one request under way adds: L <= H Delta t / 2, as a cycle lasts for two delays then.
    """
    rows = run.table(STABILITY)
    asked = run.manifest["configuration"]
    horizon, period_s = int(asked["horizon"]), float(asked["period_ns"]) / 1e9
    table = rows.pivot_table(index="execution_horizon", columns="latency_s", values="stall_share", dropna=False)
    mode = str(rows["mode"].iloc[0])
    figure = new_figure(
        2.9, title_of(run, f"Stalled share of the ticks, {mode}", f"shape of {rows['latency'].iloc[0]}")
    )
    axes = figure.subplots()
    mesh = axes.pcolormesh(
        table.columns.to_numpy(dtype="float64") * 1e3,
        table.index.to_numpy(dtype="float64"),
        table.to_numpy(dtype="float64", na_value=np.nan),
        cmap="Oranges",
        vmin=0,
        vmax=1,
        shading="nearest",
        rasterized=True,
    )
    figure.colorbar(mesh, ax=axes, label="stalled share", pad=0.02)
    delay = np.arange(horizon + 1)
    axes.plot(delay * period_s * 1e3, horizon - delay, color=_INK, label="$s = H - d$")
    if "under_way=many" not in mode:
        axes.axvline(horizon / 2 * period_s * 1e3, color=_INK, linestyle="--", label="$d = H / 2$: one under way")
    axes.set_xlim(0, horizon * period_s * 1e3)
    axes.set_ylim(0.5, horizon + 0.5)
    axes.set_xlabel("mean latency, L (ms)")
    axes.set_ylabel("execution horizon, s (ticks)")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def build_triggers(run: Run) -> Figure:
    """Draw P(stall) over the trigger with its closed form, a line a source, and where each rule ends up."""
    rows = run.table(TRIGGERS)
    epsilon = float(run.manifest["configuration"]["epsilon"])
    groups = sources_of(rows_of(run))[:_MOST_PANELS]
    more = "line: closed form; dots: simulated; 0 lies at the bottom"
    figure = new_figure(2.6 + 0.16 * len(groups), title_of(run, "P(stall) against the trigger of queue", more))
    axes = figure.subplots()
    sources: list[Any] = []
    rules: list[Any] = []
    floor = min(epsilon, 1 / max(int(rows["boundaries"].max()), 1)) / 2
    for place, (name, cells) in enumerate(groups):
        colour, line, _ = LOOKS[place % len(LOOKS)]
        mine = rows[rows["latency"] == name]
        told = mine[mine["p_stall_closed"].notna()]
        closed = np.maximum(told["p_stall_closed"].to_numpy(dtype="float64"), floor)
        axes.plot(told["trigger"].to_numpy(dtype="float64"), closed, line, color=colour, linewidth=0.9)
        label = short(name, LINE_CHARS - 8)
        sources += axes.plot([], [], line, color=colour, label=label)
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
                if cell["rule"] == rule and cell["trigger"] is not None:
                    at = max(cell["p_stall_cycle"] or 0.0, floor)
                    axes.plot(cell["trigger"], at, marker, color=colour, markerfacecolor="none", markersize=7)
    for rule, marker in _RULES.items():
        if any(cell["rule"] == rule for _, cells in groups for cell in cells):
            look: dict[str, Any] = {"markerfacecolor": "none", "markersize": 6, "linestyle": "none"}
            rules += axes.plot([], [], marker, color=_INK, label=rule, **look)
    axes.axhline(epsilon, color=_INK, linestyle=":", linewidth=0.8)
    axes.text(0.01, epsilon, f"epsilon = {epsilon:.3g}", transform=axes.get_yaxis_transform(), va="bottom")
    axes.set_yscale("log")
    axes.set_ylim(floor * 0.8, 1.3)
    axes.set_xlabel("trigger, m (actions left at the request)")
    axes.set_ylabel("P(stall) a cycle")
    axes.legend(handles=rules, loc="upper right", ncols=2, columnspacing=1.0)
    figure.legend(handles=sources, loc="outside lower center")
    return figure


def build_reactions(run: Run) -> Figure:
    """Draw the distribution of reaction times, a panel a source and a line a mode, the closed form dashed over it."""
    rows = run.table(REACTIONS)
    groups = sources_of(rows_of(run))[:_MOST_PANELS]
    names = list(dict.fromkeys(_who(cell) for _, cells in groups for cell in cells if _drawn(cell)))
    what = "from an event to the first tick that knows of it"
    foot_in = 0.17 * -(-(len(names) + 1) // 2)
    figure = new_figure(0.6 + foot_in + 1.6 * len(groups), title_of(run, "Reaction time", what))
    panels = figure.subplots(len(groups), 1, squeeze=False)[:, 0]
    for axes, (source, cells) in zip(panels, groups, strict=True):
        for cell in filter(_drawn, cells):
            colour, line, _ = LOOKS[names.index(_who(cell)) % len(LOOKS)]
            mine = rows[rows["cell"] == cell["cell"]]
            _draw_distribution(axes, mine, colour, line)
        axes.set_title(short(source, LINE_CHARS), loc="left", pad=2)
        axes.set_ylim(0, 1)
        shown = rows[rows["cell"].isin([cell["cell"] for cell in cells if _drawn(cell)]) & (rows["share"] <= _BULK)]
        axes.set_xlim(0, float(shown["reaction_s"].max()) * 1e3 * 1.15)
        axes.set_ylabel("share")
    panels[-1].set_xlabel("reaction time (ms)")
    handles: list[Any] = [
        panels[-1].plot([], [], LOOKS[place % len(LOOKS)][1], color=LOOKS[place % len(LOOKS)][0], label=name)[0]
        for place, name in enumerate(names)
    ]
    handles += panels[-1].plot([], [], ":", color="black", label="closed form")
    figure.legend(handles=handles, loc="outside lower center", ncols=2, columnspacing=1.0)
    return figure


def _draw_distribution(axes: Axes, rows: Any, colour: str, line: str) -> None:
    share = rows["share"].to_numpy(dtype="float64")
    axes.plot(rows["reaction_s"].to_numpy(dtype="float64") * 1e3, share, line, color=colour)
    told = rows[rows["closed_s"].notna()]
    axes.plot(
        told["closed_s"].to_numpy(dtype="float64") * 1e3,
        told["share"].to_numpy(dtype="float64"),
        ":",
        color="black",
        linewidth=0.8,
    )


def _drawn(cell: dict[str, Any]) -> bool:
    """Whether a cell is drawn among others: the modes as given, and the calibrated trigger."""
    return cell["rule"] in {"given", "calibrated"}


def _who(cell: dict[str, Any]) -> str:
    return str(cell["mode"]) if cell["rule"] == "given" else f"{cell['mode']}, {cell['rule']}"


def title_of(run: Run, what: str, more: str) -> str:
    """Return what is drawn, and under which setting."""
    asked = run.manifest["configuration"]
    setting = f"H = {asked['horizon']}, {asked['control_hz']:g} Hz, d by {asked['rounding']}"
    return "\n".join(textwrap.fill(line, LINE_CHARS) for line in (f"{what}, {setting}", more))
