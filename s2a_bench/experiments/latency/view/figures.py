"""The figures of a latency run: bars, stage breakdown, distribution."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from statistics import median
from typing import TYPE_CHECKING

from s2a_bench.experiments.references import bars_of
from s2a_bench.experiments.requests import (
    Floats,
    RequestCell,
    action_shape,
    caption_for,
    cells_of,
    groups_present,
    metric_phrase,
    observation_of,
    titles,
)
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
    write_beside,
)
from s2a_bench.writers.style import GROUP_FILLS, RESIDUAL_FILL, cell_styles
from s2a_bench.writers.tables import number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun


def build_latency_bars(run: StoredRun, against: str = "") -> Figure:
    """Draw medians of e2e without inference, a bar a cell (the paper's figure 4), from zero on a linear axis."""
    cells, metric = _shown(run)
    styles = cell_styles({cell.name: cell.path for cell in cells})
    bars = [Bar.of(_label(cell), cell.values_ms(metric), styles[cell.name][0]) for cell in cells]
    others = bars_of(against, "latency_bars")
    caption = _caption(run, cells, "Medians", metric, WHISKERS, *others.notes)
    return build_bars(caption, [*bars, *others.bars], _axis_label(metric), others.label)


def build_stage_breakdown(run: StoredRun) -> Figure:
    """Draw the medians of the groups of stages, stacked, the residual hatched (the paper's figure 6).

    A line marks the median of the whole; medians of stages do not add up to it. If the cells differ by more than
    `WIDE_SPREAD`, a second panel shows shares, where short bars are legible.
    """
    from matplotlib.patches import Patch

    cells, metric = _shown(run)
    groups = [group for group in groups_present(cells) if group != "inference" or metric == "e2e"]
    fills = {group: GROUP_FILLS[group] for group in groups} | {"residual": RESIDUAL_FILL}
    wholes = [median(cell.values_ms(metric).tolist()) for cell in cells]
    medians = [{name: _median(cell, name, cell.values_ms(metric).size) for name in fills} for cell in cells]
    shares = max(wholes) > WIDE_SPREAD * min(wholes)
    panels = 2 if shares else 1
    legend_rows = -(-(len(fills) + 1) // 4)
    height = 0.85 + panels * (0.3 + 0.34 * len(cells)) + 0.16 * legend_rows
    notes = ["The line is the median of the whole; medians of the stages need not add up to it."]
    notes += ["Shares are of the sum of the stages."] if shares else []
    apart = {cell.name: {group: ends for group in groups if (ends := cell.group_ends(group)).lo.size} for cell in cells}
    if any(apart.values()):
        notes.append("Whiskers: between two hosts network may end, and return begin, anywhere in them.")
    figure = new_figure(height, _caption(run, cells, "Stages, medians", metric, *notes))
    all_axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
    for axes, share in zip(all_axes, (False, True), strict=False):
        for place, (part, whole) in enumerate(zip(medians, wholes, strict=True)):
            left, all_of_it = 0.0, sum(part.values())
            for name, (colour, hatch) in fills.items():
                width = part[name] * (100 / all_of_it if share else 1)
                axes.barh(place, width, 0.66, left, color=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3)
                left += width
                if not share and name in apart[cells[place].name]:
                    edge, half = left - width * (name == "return"), apart[cells[place].name][name].half
                    draw_over(axes, (max(0.0, edge - half), edge + half), (place, place), "|-", "")
            if not share:
                draw_over(axes, (whole, whole), (place - 0.42, place + 0.42), "-", "" if place else "whole")
                write_beside(axes, place, number(whole))
        name_rows(axes, [_label(cell) for cell in cells])
        axes.set_xlim(0, 100 if share else 1.02 * max(*wholes, *(sum(part.values()) for part in medians)))
        axes.set_xlabel("share (%)" if share else _axis_label(metric))
    handles: list[object] = [
        Patch(facecolor=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3, label=name)
        for name, (colour, hatch) in fills.items()
    ]
    handles += [line for line in all_axes[0].get_lines() if line.get_label() == "whole"]
    columns = -(-len(handles) // legend_rows)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, columnspacing=1.0)
    return figure


def build_latency_distribution(run: StoredRun) -> Figure:
    """Draw the empirical distribution of e2e without inference, a line a cell; logarithmic if wide."""
    cells, metric = _shown(run)
    styles = cell_styles({cell.name: cell.path for cell in cells})
    named = zip(titles(cells), cells, strict=True)
    lines = {title: (cell.values_ms(metric), styles[cell.name]) for title, cell in named}
    return build_distribution(_caption(run, cells, "Distribution", metric), lines, "samples", _axis_label(metric))


def latency_figures(run: StoredRun, against: str = "") -> dict[str, Callable[[], Figure]]:
    if not _shown(run)[0]:
        return {}
    return {
        "latency_bars": lambda: build_latency_bars(run, against),
        "stages": lambda: build_stage_breakdown(run),
        "distribution": lambda: build_latency_distribution(run),
        **dict(chain.from_iterable(figures(run).items() for figures in shown("figures"))),
    }


def _shown(run: StoredRun) -> tuple[list[RequestCell], str]:
    """Return the cells that can be drawn, and the metric: e2e only if no cell has e2e without inference."""
    cells = cells_of(run)
    for metric in ("e2e_without_inference", "e2e"):
        if shown := [cell for cell in cells if cell.values_ms(metric).size]:
            return shown, metric
    return [], "e2e"


def _caption(run: StoredRun, cells: list[RequestCell], what: str, metric: str, *notes: str) -> tuple[str, ...]:
    facts = [observation_of(run, cells), *sorted({f"{cell.about['mode']} mode" for cell in cells})]
    facts += [f"chunks of {shape}"] if (shape := action_shape(run)) else []
    shown = {cell.name for cell in cells}
    left_out = [f"{cell.name} not shown (inference unknown)." for cell in cells_of(run) if cell.name not in shown]
    return caption_for(run, cells, f"{what}: {metric_phrase(metric).lower()}", facts, (*notes, *left_out))


def _axis_label(metric: str) -> str:
    return "e2e without inference (ms)" if metric == "e2e_without_inference" else "e2e, inference included (ms)"


def _label(cell: RequestCell) -> str:
    name = cell.label.replace("?", "\n?")
    return f"{name}\n({cell.payload})" if cell.payload else name


def _median(cell: RequestCell, name: str, n: int) -> float:
    """Return the median of a group over all samples, of intervals the middle; one without the group counts as 0."""
    if (ends := cell.group_ends(name)).lo.size:
        return ends.middle
    values: Floats = cell.values_ms("residual") if name == "residual" else cell.group_ms(name)
    return float(median((*values.tolist(), *[0.0] * (n - values.size))))


def _edge(name: str) -> str:
    return "black" if name == "residual" else "white"
