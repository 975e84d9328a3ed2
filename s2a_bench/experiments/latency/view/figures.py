"""The figures of a latency run, drawn from its samples: bars, stage breakdown, distribution; PNG and PDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

from s2a_bench.experiments.paper import CAVEAT, LABEL, paper_latency
from s2a_bench.experiments.requests import Cell, asked, cells_of, chunks, groups_present, spelled, title_of, titles
from s2a_bench.stats import summarise
from s2a_bench.writers.figures import (
    LINE_CHARS,
    WIDE_SPREAD,
    Bar,
    build_bars,
    build_distribution,
    name_rows,
    new_figure,
    write_beside,
)
from s2a_bench.writers.style import GROUP_FILLS, RESIDUAL_FILL, cell_looks
from s2a_bench.writers.tables import mean_sd, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.experiments.requests import Floats
    from s2a_bench.store.run import Run


def build_latency_bars(run: Run, *, against_paper: bool = False) -> Figure:
    """Draw mean ± sd of e2e without inference, a bar a cell (the paper's figure 4), from zero on a linear axis."""
    cells, metric = _shown(run)
    looks = cell_looks({cell.name: cell.path for cell in cells})
    found = [(cell, summarise(cell.values_ms(metric))) for cell in cells]
    bars = [Bar(_label(cell), each.mean, each.sd, mean_sd(each), looks[cell.name][0]) for cell, each in found]
    if against_paper:
        bars += [
            Bar(f"paper:\n{claim.name}", claim.mean_ms, claim.sd_ms, f"{claim.mean_ms:g} ± {claim.sd_ms:.1f}")
            for claim in paper_latency()
        ]
    paper = f"{LABEL}\n{textwrap.fill(CAVEAT, LINE_CHARS - 12)}" if against_paper else ""
    return build_bars(_title(run, cells, "Mean ± sd", metric), bars, _axis_label(metric), paper)


def build_stage_breakdown(run: Run) -> Figure:
    """Draw the mean of every group of stages, stacked, the residual hatched (the paper's figure 6).

    Means, because they add up to the mean of the whole; medians do not. Where the cells differ by more than
    `WIDE_SPREAD` a second panel shows each group's share, so that the short bars can be read too.
    """
    from matplotlib.patches import Patch

    cells, metric = _shown(run)
    groups = [group for group in groups_present(cells) if group != "inference" or metric == "e2e"]
    fills = {group: GROUP_FILLS[group] for group in groups} | {"residual": RESIDUAL_FILL}
    # A sample without a group spent no time there: the sum over the cell's samples is what adds up.
    counts = [cell.values_ms(metric).size for cell in cells]
    parts = [{name: _part(cell, name).sum() / n for name in fills} for cell, n in zip(cells, counts, strict=True)]
    wholes = [sum(part.values()) for part in parts]
    shares = bool(wholes) and max(wholes) > WIDE_SPREAD * min(wholes)
    panels = 2 if shares else 1
    height = 0.95 + panels * (0.3 + 0.34 * len(cells)) + 0.16 * -(-len(fills) // 4)
    figure = new_figure(height, _title(run, cells, "Stages, means", metric))
    all_axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
    for axes, share in zip(all_axes, (False, True), strict=False):
        for place, (part, whole) in enumerate(zip(parts, wholes, strict=True)):
            left = 0.0
            for name, (colour, hatch) in fills.items():
                width = part[name] * (100 / whole if share else 1)
                axes.barh(place, width, 0.66, left, color=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3)
                left += width
            if not share:
                write_beside(axes, place, number(whole))
        name_rows(axes, [_label(cell) for cell in cells])
        axes.set_xlim(0, 100 if share else None)
        axes.set_xlabel("share (%)" if share else _axis_label(metric))
    handles = [
        Patch(facecolor=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3, label=name)
        for name, (colour, hatch) in fills.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.0)
    return figure


def build_latency_distribution(run: Run) -> Figure:
    """Draw the empirical distribution of e2e without inference, a line a cell; logarithmic where it spreads widely."""
    cells, metric = _shown(run)
    looks = cell_looks({cell.name: cell.path for cell in cells})
    named = zip(titles(cells), cells, strict=True)
    lines = {title: (cell.values_ms(metric), looks[cell.name]) for title, cell in named}
    return build_distribution(_title(run, cells, "Distribution", metric), lines, "samples", _axis_label(metric))


def latency_figures(run: Run, *, against_paper: bool = False) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name; the paper's values only when asked for. No samples, no figures."""
    if not _shown(run)[0]:
        return {}
    return {
        "latency_bars": lambda: build_latency_bars(run, against_paper=against_paper),
        "stages": lambda: build_stage_breakdown(run),
        "distribution": lambda: build_latency_distribution(run),
    }


def _shown(run: Run) -> tuple[list[Cell], str]:
    """Return the cells that can be drawn and by what: e2e only where no cell tells its inference apart."""
    cells = cells_of(run)
    for metric in ("e2e_without_inference", "e2e"):
        if shown := [cell for cell in cells if cell.values_ms(metric).size]:
            return shown, metric
    return [], "e2e"


def _title(run: Run, cells: list[Cell], what: str, metric: str) -> str:
    facts = [asked(run, cells), *sorted({f"{cell.about['mode']} mode" for cell in cells})]
    facts += [f"chunks of {shape}"] if (shape := chunks(run)) else []
    shown = {cell.name for cell in cells}
    left_out = [f"{cell.name} not shown (inference unknown)" for cell in cells_of(run) if cell.name not in shown]
    return title_of(run, cells, f"{what}: {spelled(metric).lower()}", facts, left_out)


def _axis_label(metric: str) -> str:
    return "e2e without inference (ms)" if metric == "e2e_without_inference" else "e2e, inference included (ms)"


def _label(cell: Cell) -> str:
    """Name a row by its cell, and by what travels where that is not said yet."""
    name = cell.label.replace("?", "\n?")
    return f"{name}\n({cell.payload})" if cell.payload else name


def _part(cell: Cell, name: str) -> Floats:
    return cell.values_ms("residual") if name == "residual" else cell.group_ms(name)


def _edge(name: str) -> str:
    return "black" if name == "residual" else "white"
