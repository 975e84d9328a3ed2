"""The figure of a comparison: a forest plot, a row a cell, a panel a metric, every change with its interval."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Final

from s2a_bench.report.compare.comparison import SAME, TOO_FEW, UNCLEAR
from s2a_bench.report.compare.tables import percent, title
from s2a_bench.writers.figures import LINE_CHARS, name_rows, new_figure, write_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.report.compare.comparison import ComparedRuns, Comparison

_LOOKS: Final = {
    "better": ("#009E73", "^"),
    "worse": ("#D55E00", "v"),
    "lower": ("#0072B2", "<"),
    "higher": ("#0072B2", ">"),
    SAME: ("#000000", "o"),
    UNCLEAR: ("#777777", "D"),
    TOO_FEW: ("#777777", "x"),
}
"""Verdict -> colour and marker, so that colour alone tells nothing."""


def build_forest(compared: ComparedRuns) -> Figure | None:
    """Draw the changes in per cent; the band is what is too small to be called a change.

    Every metric has its own axis. Cells that are alike to the last digit are counted, not drawn; None where no row is
    left.
    """
    panels: dict[str, list[Comparison]] = {}
    alike: dict[str, int] = {}
    for one in compared.comparisons:
        if one.change.bounds and not any(one.change.bounds):
            alike[one.name] = alike.get(one.name, 0) + 1
        elif one.change.relative is not None:
            panels.setdefault(one.name, []).append(one)
    if not panels:
        return None
    heights = [len(rows) + 2.2 for rows in panels.values()]
    lines = (f"{compared.command}: B against A", title(compared))
    figure = new_figure(0.75 + 0.17 * sum(heights), "\n".join(textwrap.fill(line, LINE_CHARS) for line in lines))
    every = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (name, rows) in zip(every, panels.items(), strict=True):
        _panel(axes, rows, compared.least)
        more = f" (+{alike[name]} alike)" if name in alike else ""
        axes.set_title(f"{name}{more}", loc="left", pad=2)
    every[-1].set_xlabel("change (%)")
    seen = list(dict.fromkeys(one.verdict for rows in panels.values() for one in rows))
    handles = [
        every[0].plot([], [], color=_LOOKS[name][0], marker=_LOOKS[name][1], linestyle="", markersize=4, label=name)[0]
        for name in _LOOKS
        if name in seen
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.0)
    return figure


def _panel(axes: Axes, rows: list[Comparison], least: float) -> None:
    """Draw one metric."""
    axes.axvspan(-100 * least, 100 * least, color="#EEEEEE", linewidth=0)
    axes.axvline(0, color="black", linewidth=0.6)
    for place, one in enumerate(rows):
        colour, marker = _LOOKS[one.verdict]
        relative = one.change.relative or 0.0
        if bounds := one.change.bounds:
            axes.plot([100 * bound for bound in bounds], [place, place], color=colour, linewidth=1.2)
        axes.plot(100 * relative, place, color=colour, marker=marker, markersize=4)
        write_beside(axes, place, f"{percent(relative)} %")
    name_rows(axes, [one.pair.name for one in rows])
