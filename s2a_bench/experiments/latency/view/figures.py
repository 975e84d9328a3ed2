"""The figures of a latency run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from statistics import median
from typing import TYPE_CHECKING

from s2a_bench.experiments.references import bars_of
from s2a_bench.experiments.requests import GROUP, RequestCell, RequestCells, metric_phrase
from s2a_bench.transport.surroundings import shown
from s2a_bench.writers.figures import (
    WHISKERS,
    WIDE_SPREAD,
    Bar,
    build_bars,
    build_distribution,
    draw_over,
    name_rows,
    new_figure,
    on_page,
    write_beside,
)
from s2a_bench.writers.style import GROUP_FILLS, RESIDUAL_FILL, cell_styles
from s2a_bench.writers.tables import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RESIDUAL = "residual"


def latency_figures(cells: RequestCells, against: str = "") -> dict[str, Callable[[], Figure]]:
    """Return what draws each figure, of e2e without inference; of e2e if no cell has that."""
    metric = "e2e_without_inference" if cells.having("e2e_without_inference") else "e2e"
    drawn = cells.having(metric)
    if not drawn:
        return {}
    label = "e2e without inference (ms)" if metric == "e2e_without_inference" else "e2e, inference included (ms)"
    styles = cell_styles({cell.name: cell.path for cell in drawn})
    left_out = [f"{cell.name} not shown (inference unknown)." for cell in cells if cell not in drawn]

    def caption(what: str, *notes: str) -> tuple[str, ...]:
        facts = [drawn.observation, *sorted({f"{cell.about['mode']} mode" for cell in drawn})]
        facts += [f"chunks of {shape}"] if (shape := cells.action_shape) else []
        return drawn.caption(f"{what}: {metric_phrase(metric).lower()}", facts, (*notes, *left_out))

    def medians() -> Figure:
        """Draw a bar a cell (the paper's figure 4), from zero on a linear axis."""
        others = bars_of(against, "latency_bars")
        bars = [Bar.of(_label(cell), cell.values(metric), styles[cell.name][0]) for cell in drawn]
        return build_bars(caption("Medians", WHISKERS, *others.notes), [*bars, *others.bars], label, others.label)

    def stages() -> Figure:
        """Draw the medians of the groups of stages (the paper's figure 6)."""
        groups = [group for group in drawn.groups if group != "inference" or metric == "e2e"]
        bars = [StageBar.of(cell, groups, metric) for cell in drawn]
        return build_stage_breakdown(caption("Stages, medians", *notes_of(bars)), bars, label)

    def distribution() -> Figure:
        """Draw a line a cell; logarithmic if wide."""
        named = zip(drawn.titles, drawn, strict=True)
        lines = {title: (cell.values(metric), styles[cell.name]) for title, cell in named}
        return build_distribution(caption("Distribution"), lines, "samples", label)

    around = chain.from_iterable(figures(cells.run).items() for figures in shown("figures"))
    return {"stages": stages, "latency_bars": medians, "distribution": distribution, **dict(around)}


@dataclass(frozen=True, slots=True)
class StageBar:
    """The medians of a cell in ms: of its groups of stages and the residual, and of the whole."""

    label: str
    parts: Mapping[str, float]
    """Group, or `RESIDUAL` -> its median, of an interval the middle; a group that the cell lacks is 0."""
    whole: float
    halves: Mapping[str, float]
    """Group that is an interval -> half its width."""

    @classmethod
    def of(cls, cell: RequestCell, groups: Sequence[str], metric: str) -> StageBar:
        """Take the medians over all samples that have the metric; one without a group counts as 0."""
        whole = cell.values(metric).tolist()
        metrics = {**{group: f"{GROUP}{group}" for group in groups}, RESIDUAL: RESIDUAL}
        ends = {
            name: [float(median(side.tolist())) for side in both]
            for name, column in metrics.items()
            if (both := cell.ends(column)).lo.size
        }
        spent = {name: cell.values(column).tolist() for name, column in metrics.items()}
        parts = {
            name: sum(ends[name]) / 2 if name in ends else median((*values, *[0.0] * (len(whole) - len(values))))
            for name, values in spent.items()
        }
        return cls(_label(cell), parts, median(whole), {name: (hi - lo) / 2 for name, (lo, hi) in ends.items()})

    @property
    def sum(self) -> float:
        return sum(self.parts.values())


def notes_of(bars: Sequence[StageBar]) -> list[str]:
    """Return what the caption of the breakdown says of its lines, shares and whiskers."""
    notes = ["The line is the median of the whole; medians of the stages need not add up to it."]
    if _differ(bars):
        notes.append("Shares are of the sum of the stages.")
    if any(bar.halves for bar in bars):
        notes.append("Whiskers: between two hosts network may end, and return begin, anywhere in them.")
    return notes


def _differ(bars: Sequence[StageBar]) -> bool:
    """Return True if short bars are legible as shares alone."""
    wholes = [bar.whole for bar in bars]
    return max(wholes) > WIDE_SPREAD * min(wholes)


def build_stage_breakdown(caption: Sequence[str], bars: Sequence[StageBar], label: str) -> Figure:
    """Draw the medians of the groups of stages, stacked, the residual hatched.

    A line marks the median of the whole; medians of stages do not add up to it. If the cells differ by more than
    `WIDE_SPREAD`, a second panel shows shares.
    """
    from matplotlib.patches import Patch

    fills = {name: RESIDUAL_FILL if name == RESIDUAL else GROUP_FILLS[name] for name in bars[0].parts}
    beside = on_page()
    panels = 2 if _differ(bars) else 1
    rows, legend_rows, row_in = (1, 1, 0.26) if beside else (panels, -(-(len(fills) + 1) // 4), 0.34)
    figure = new_figure(0.85 + rows * (0.3 + row_in * len(bars)) + 0.16 * legend_rows, caption)
    times, *shares = figure.subplots(rows, panels // rows, squeeze=False).flat
    for place, bar in enumerate(bars):
        _draw_stages(times, place, bar, fills, 1.0)
        left = 0.0
        for name, part in bar.parts.items():
            left += part
            if name in bar.halves:
                edge, half = left - part * (name == "return"), bar.halves[name]
                draw_over(times, (max(0.0, edge - half), edge + half), (place, place), "|-", "")
        draw_over(times, (bar.whole, bar.whole), (place - 0.42, place + 0.42), "-", "" if place else "whole")
        write_beside(times, place, number(bar.whole))
    times.set_xlim(0, 1.02 * max(max(bar.whole, bar.sum) for bar in bars))
    times.set_xlabel(label)
    for axes in shares:
        for place, bar in enumerate(bars):
            _draw_stages(axes, place, bar, fills, 100 / bar.sum)
        axes.set_xlim(0, 100)
        axes.set_xlabel("share (%)")
    for axes in (times, *shares):
        name_rows(axes, [bar.label.replace("\n?", "?").replace("\n", " ") if beside else bar.label for bar in bars])
        axes.tick_params(labelleft=axes is times or not beside)
    handles: list[object] = [
        Patch(facecolor=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3, label=name)
        for name, (colour, hatch) in fills.items()
    ]
    handles += [line for line in times.get_lines() if line.get_label() == "whole"]
    figure.legend(handles=handles, loc="outside lower center", ncols=-(-len(handles) // legend_rows), columnspacing=1.0)
    return figure


def _draw_stages(axes: Axes, place: int, bar: StageBar, fills: Mapping[str, tuple[str, str]], scale: float) -> None:
    left = 0.0
    for name, (colour, hatch) in fills.items():
        width = bar.parts[name] * scale
        axes.barh(place, width, 0.66, left, color=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3)
        left += width


def _label(cell: RequestCell) -> str:
    name = cell.label.replace("?", "\n?")
    return f"{name}\n({cell.payload})" if cell.payload else name


def _edge(name: str) -> str:
    return "black" if name == RESIDUAL else "white"
