"""The figures of the studies: targets against rho, frontiers, drift block by block, wrong beliefs; PNG and PDF."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import WIDE_IN
from studies.tables import WORLD, first_seed, rows_of
from studies.targets import END, ONLINE, START, WORST
from studies.worlds import HARD

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

"""Both columns of a two-column paper."""
_STYLES: Final = (("#0072B2", "-", "o"), ("#D55E00", "--", "s"), ("#009E73", "-.", "^"), ("#CC79A7", ":", "D"))
"""Colour, line and marker of the first, second, ... thing that is compared."""
_INK: Final = "#222222"
_LIMIT: Final[dict[str, Any]] = {"color": _INK, "linestyle": (0, (4, 2)), "linewidth": 0.8, "zorder": 1}
_DRAWN: Final = "Plans are drawn from models of the arrivals; nothing is measured."


def build_targets(run: StoredRun) -> Figure:
    """Draw stream-to-act's share of stalled plans and regrets, a point a setting, against rho."""
    rows = first_seed(rows_of(run))
    rows = rows[rows["policy"] == ONLINE]
    hard = rows[rows["rho"] > HARD]
    figure = new_figure(4.9, (f"{ONLINE}: {len(rows)} settings, {int(rows['plans'].max()):,} plans each", _DRAWN))
    whole = figure.subplots(3, 1, sharex=True)
    panels = {"p_any_stall": "P(any stall)", "start_regret": r"start regret over $S_0$", "end_regret": "end regret"}
    for axes, (column, label) in zip(whole, panels.items(), strict=True):
        for (rate, part), (colour, _, marker) in zip(_by(rows, ["tokens_per_s"]), _STYLES, strict=False):
            face = {"facecolors": "none", "edgecolors": colour, "linewidths": 0.7}
            axes.scatter(part["rho"], part[column], 11, marker=marker, label=f"{rate[0]:g} tokens/s", **face)
        axes.axvline(HARD, color="#999999", linewidth=0.6, linestyle=":")
        axes.set_ylabel(label)
    _limit(whole[0], WORST, f"limit of every setting: {_percent(WORST)}")
    _shares(whole[0], 1 / float(rows["plans"].max()), top=0.05)
    for axes, column, limit in ((whole[1], "start_regret", START), (whole[2], "end_regret", END)):
        mean = float(hard[column].mean())
        _limit(axes, limit, f"limit of the mean: {_percent(limit)}")
        axes.hlines(mean, HARD, float(rows["rho"].max()), color=_INK, linewidth=1.6)
        _write(axes, mean, rf"mean for $\rho$ > {HARD:g}: {mean * 100:.1f} %")
        axes.yaxis.set_major_formatter(_percent)
    whole[0].set_xscale("log")
    whole[2].xaxis.set_major_formatter(lambda value, _place: f"{value:g}")
    whole[2].set_xlabel(r"$\rho = L\,/\,(R\,T_\mathrm{nom})$")
    figure.legend(*whole[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def build_frontier(run: StoredRun) -> Figure:
    """Draw P(any stall) against start regret as lambda grows, a panel a world, a colour a family of gaps."""
    rows = first_seed(rows_of(run))
    epsilon = float(run.manifest["configuration"]["epsilon"])
    plans = int(rows["plans"].max())
    figure = new_figure(5.2, (f"What rare stalls cost; {plans:,} plans a point", _DRAWN))
    worlds = _by(rows, WORLD)
    grid = figure.subplots(-(-len(worlds) // 2), 2, sharex=True, squeeze=False)
    families = list(rows["family"].unique())
    for axes, (_, world) in zip(grid.flat, worlds, strict=False):
        for family, (colour, line, marker) in zip(families, _STYLES, strict=False):
            points = world[world["family"] == family]
            for policy, width in ((ONLINE, 1.3), ("s2a-quantile", 0.6)):
                tried = _needed(points[(points["policy"] == policy) & (points["condition"] == "")])
                axes.plot(100 * tried["p_any_stall"], tried["start_regret"], line, color=colour, linewidth=width)
            for condition, fill in (("calibrated", colour), ("calibrated, expected", "white")):
                chosen = points[points["condition"] == condition]
                look: Any = {"markersize": 5, "color": fill, "markeredgecolor": colour, "markeredgewidth": 0.9}
                axes.plot(100 * chosen["p_any_stall"], chosen["start_regret"], marker, clip_on=False, zorder=4, **look)
        axes.axvline(100 * epsilon, color="#999999", linewidth=0.6, linestyle=":")
        axes.set_title(_world(world).replace(": ", "\n"), loc="left", pad=2)
        axes.set_xscale("symlog", linthresh=100 / plans, linscale=0.5)
        axes.set_xlim(-25 / plans, 100)
        _few_ticks(axes.xaxis, [0, *(share for share in (0.1, 1, 10, 100) if share > 100 / plans)])
        axes.xaxis.set_major_formatter(lambda value, _place: f"{value:g}")
        axes.yaxis.set_major_formatter(_percent)
        axes.set_ylim(bottom=0)
    for axes in grid[-1]:
        axes.set_xlabel("P(any stall) (%)")
    for axes in grid[:, 0]:
        axes.set_ylabel(r"start regret over $S_0$")
    figure.legend(handles=_frontier_legend(families, epsilon), loc="outside lower center", ncols=2)
    return figure


def build_drift(run: StoredRun) -> Figure:
    """Draw P(any stall) block by block: prior and lambda fixed, lambda tracked, the prior refitted too."""
    rows = first_seed(rows_of(run))
    rows = rows.assign(
        drift=[text.partition(", ")[0] for text in rows["condition"]],
        arm=[text.partition(", ")[2] for text in rows["condition"]],
    )
    epsilon = float(run.manifest["configuration"]["epsilon"])
    plans = int(rows["plans"].max())
    worlds, drifts = _by(rows, WORLD), list(rows["drift"].unique())
    caption = (f"Drift from the third block on; {plans:,} plans a block", _DRAWN)
    figure = new_figure(0.6 + 1.5 * len(worlds), caption, WIDE_IN)
    grid = figure.subplots(len(worlds), len(drifts), sharex=True, sharey=True, squeeze=False)
    for line_of_axes, (_, world) in zip(grid, worlds, strict=True):
        for axes, drift in zip(line_of_axes, drifts, strict=True):
            here = world[world["drift"] == drift]
            for (arm, part), (colour, line, marker) in zip(_by(here, ["arm"]), _STYLES, strict=False):
                place = part["block"] + 1
                axes.plot(
                    place, part["p_any_stall"], line, marker=marker, markersize=3, color=colour, label=_ARMS[arm[0]]
                )
            axes.axhline(epsilon, **_LIMIT)
            axes.set_title(f"{'no drift' if drift == 'none' else f'gaps: {drift}'}\n{_world(world)}", loc="left", pad=2)
            axes.set_xticks(sorted(int(block) + 1 for block in rows["block"].unique()))
            _shares(axes, 1 / plans, top=1.0)
    for axes in grid[:, 0]:
        axes.set_ylabel("P(any stall)")
    for axes in grid[-1]:
        axes.set_xlabel("block of plans")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    limit = rf"$\epsilon$ = {_percent(epsilon)}"
    handles.append(_line(limit, **_LIMIT))
    labels.append(limit)
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def build_misfit(run: StoredRun) -> Figure:
    """Draw what a wrong length, granularity or rate costs: stalls above, late starts below, a line a world."""
    rows = first_seed(rows_of(run))
    kinds = {"N": "skills a plan", "L": "tokens a skill", "gap": "mean gap of the prior"}
    rows = rows.assign(
        kind=[text.split()[0] for text in rows["condition"]], step=[text.split()[-1] for text in rows["condition"]]
    )
    caption = (f"One belief is wrong; {int(rows['plans'].max()):,} plans a point", _DRAWN)
    figure = new_figure(3.4, caption, WIDE_IN)
    grid = figure.subplots(2, len(kinds), sharex="col", sharey="row")
    for column, (kind, what) in enumerate(kinds.items()):
        for (_, part), (colour, line, marker) in zip(_by(rows[rows["kind"] == kind], WORLD), _STYLES, strict=False):
            for axes, value in zip(grid[:, column], ("p_any_stall", "start_regret"), strict=True):
                axes.plot(
                    part["step"], part[value], line, marker=marker, markersize=3, color=colour, label=_world(part)
                )
                axes.axvline("+0" if kind == "N" else "1", color="#999999", linewidth=0.6, linestyle=":")
                axes.yaxis.set_major_formatter(_percent)
        grid[0, column].set_title(f"believed {what}", loc="left", pad=2)
        grid[1, column].set_xlabel("more than true" if kind == "N" else "over the true one")
    _shares(grid[0, 0], 1 / float(rows["plans"].max()), top=1.0)
    grid[0, 0].set_ylabel("P(any stall)")
    grid[1, 0].set_ylabel(r"start regret over $S_0$")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


_ARMS: Final = {
    "fixed": r"prior and $\lambda$ fixed",
    "tracked": r"$\lambda$ tracked",
    "refitted": r"$\lambda$ tracked, prior refitted",
}


def _by(rows: pd.DataFrame, columns: list[str]) -> list[tuple[tuple[Any, ...], pd.DataFrame]]:
    return [(key, part) for key, part in rows.groupby(columns, sort=False)]


def _world(rows: pd.DataFrame) -> str:
    """Name the setting that rows share."""
    first = rows.iloc[0]
    rate, tokens, skills, t_nom_s = (first[name] for name in WORLD)
    return rf"$\rho$ = {first['rho']:.2f}: R {rate:g}, L {tokens:g}, N {skills:g}, T {t_nom_s:g} s"


def _percent(value: float, _place: object = None) -> str:
    return f"{value * 100:g} %"


def _needed(points: pd.DataFrame) -> pd.DataFrame:
    return points[(points["stalled"] == 0).shift(fill_value=False).cummax() == 0]


def _shares(axes: Axes, least: float, top: float) -> None:
    """Give shares a logarithmic axis that has a place for none at all; ``least`` is the least that is not none."""
    axes.set_yscale("symlog", linthresh=least, linscale=0.5)
    axes.set_ylim(-least / 4, 1.4 * top)
    _few_ticks(axes.yaxis, [0, *(share for share in (0.001, 0.01, 0.1, 1) if least < share <= top)])
    axes.yaxis.set_major_formatter(_percent)


def _few_ticks(axis: Axis, values: list[float]) -> None:
    """Put ticks at these values only."""
    from matplotlib.ticker import NullLocator

    axis.set_ticks(values)
    axis.set_minor_locator(NullLocator())


def _limit(axes: Axes, height: float, text: str) -> None:
    """Draw what must not be passed, and say so."""
    axes.axhline(height, **_LIMIT)
    _write(axes, height, text)


def _write(axes: Axes, height: float, text: str) -> None:
    """Write above a horizontal line, at the left end, where the easy settings leave room."""
    place: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "va": "bottom", "fontsize": 6}
    axes.annotate(text, (0.01, height), (0, 1), **place)


def _line(label: str, **look: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


def _frontier_legend(families: list[str], epsilon: float) -> list[Any]:
    """Explain colours, the two rules, and what is marked."""
    styles = zip(families, _STYLES, strict=False)
    return [
        *(_line(_FAMILIES.get(family, family), color=colour, linestyle=line) for family, (colour, line, _) in styles),
        _line(f"bold: {ONLINE}", color=_INK, linewidth=1.3),
        _line("thin: s2a-quantile (never stretches)", color=_INK, linewidth=0.6),
        *(
            _line(
                rf"$\epsilon$ = {_percent(epsilon)}, {guarantee}",
                color=fill,
                marker="o",
                markersize=5,
                linestyle="none",
                markeredgecolor="#777777",
                markeredgewidth=0.9,
            )
            for guarantee, fill in (("high-confidence", "#777777"), ("expected", "white"))
        ),
    ]


_FAMILIES: Final = {"lognormal": "even (lognormal)", "markov": "pauses (markov)", "bursty": "packets (bursty)"}
