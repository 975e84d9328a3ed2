"""The figures of a latency run, drawn from its samples: bars, stage breakdown, distribution; PNG and PDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import Cell, asked, cells_of, chunks, engine_note, groups_present
from s2a_bench.experiments.paper import CAVEAT, LABEL, paper_latency
from s2a_bench.stats import summary_of
from s2a_bench.writers.figures import LINE_CHARS, WIDE_SPREAD, logarithmic, name_rows, new_figure, write_beside
from s2a_bench.writers.style import GREY, GROUP_FILLS, RESIDUAL_FILL, cell_looks
from s2a_bench.writers.tables import mean_sd, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.store.run import Run


def build_latency_bars(run: Run, *, against_paper: bool = False) -> Figure:
    """Draw mean ± sd of e2e without inference, a bar a cell (the paper's figure 4), from zero on a linear axis."""
    from matplotlib.patches import Patch

    cells, metric = _shown(run)
    looks = cell_looks({cell.name: cell.path for cell in cells})
    bars = [(_label(cell), summary_of(cell.values_ms(metric)), looks[cell.name][0]) for cell in cells]
    rows = [(name, found.mean, found.sd or 0.0, mean_sd(found), colour) for name, found, colour in bars if found]
    if against_paper:
        rows += [
            (f"paper:\n{claim.name}", claim.mean_ms, claim.sd_ms, f"{claim.mean_ms:g} ± {claim.sd_ms:.1f}", GREY)
            for claim in paper_latency()
        ]
    figure = new_figure(
        0.75 + 0.34 * len(rows) + (0.45 if against_paper else 0), _title(run, cells, "Mean ± sd", metric)
    )
    axes = figure.subplots()
    for place, (_, mean, sd, text, colour) in enumerate(rows):
        axes.barh(place, mean, 0.62, color=colour, edgecolor="black", linewidth=0.5)
        # A time is never below zero, whatever the standard deviation is.
        axes.errorbar(mean, place, xerr=[[min(sd, mean)], [sd]], color="black", capsize=2, linewidth=0.8)
        write_beside(axes, place, text)
    name_rows(axes, [name for name, *_ in rows])
    axes.set_xlim(left=0)
    axes.set_xlabel(_axis_label(metric))
    if against_paper:
        text = f"{LABEL}\n" + textwrap.fill(CAVEAT, LINE_CHARS - 12)
        figure.legend(
            handles=[Patch(facecolor=GREY, edgecolor="black", linewidth=0.5, label=text)], loc="outside lower left"
        )
    return figure


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
                edge = "black" if name == "residual" else "white"
                axes.barh(place, width, 0.66, left, color=colour, hatch=hatch, edgecolor=edge, linewidth=0.3)
                left += width
            if not share:
                write_beside(axes, place, number(whole))
        name_rows(axes, [_label(cell) for cell in cells])
        axes.set_xlim(0, 100 if share else None)
        axes.set_xlabel("share (%)" if share else _axis_label(metric))
    handles = [
        Patch(
            facecolor=colour,
            hatch=hatch,
            edgecolor="black" if name == "residual" else "white",
            linewidth=0.3,
            label=name,
        )
        for name, (colour, hatch) in fills.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.0)
    return figure


def build_distribution(run: Run) -> Figure:
    """Draw the empirical distribution of e2e without inference, a line a cell; logarithmic where it spreads widely."""
    cells, metric = _shown(run)
    looks = cell_looks({cell.name: cell.path for cell in cells})
    figure = new_figure(2.35 + 0.14 * -(-len(cells) // 2), _title(run, cells, "Distribution", metric))
    axes = figure.subplots()
    every: list[Floats] = [cell.values_ms(metric) for cell in cells]
    for cell, values in zip(cells, every, strict=True):
        colour, line = looks[cell.name]
        axes.ecdf(values, label=cell.name, color=colour, linestyle=line)
    low, high = min(values.min() for values in every), max(values.max() for values in every)
    if low > 0 and high > WIDE_SPREAD * low:
        logarithmic(axes, high / low)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("share of samples")
    axes.set_xlabel(_axis_label(metric))
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.2)
    return figure


def latency_figures(run: Run, *, against_paper: bool = False) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name; the paper's values only when asked for. No samples, no figures."""
    if not _shown(run)[0]:
        return {}
    return {
        "latency_bars": lambda: build_latency_bars(run, against_paper=against_paper),
        "stage_breakdown": lambda: build_stage_breakdown(run),
        "distribution": lambda: build_distribution(run),
    }


def _shown(run: Run) -> tuple[list[Cell], str]:
    """Return the cells that can be drawn and by what: e2e only where no cell tells its inference apart."""
    cells = cells_of(run)
    for metric in ("e2e_without_inference", "e2e"):
        if shown := [cell for cell in cells if cell.values_ms(metric).size]:
            return shown, metric
    return [], "e2e"


def _title(run: Run, cells: list[Cell], what: str, metric: str) -> str:
    """Return what is drawn, from how many samples, of what size, and what did not really answer."""
    counts = sorted({cell.n for cell in cells})
    facts = [f"n = {' to '.join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))} a cell"]
    facts += [asked(run, cells), *sorted({f"{cell.about['mode']} mode" for cell in cells})]
    facts += [f"chunks of {shape}"] if (shape := chunks(run)) else []
    facts += [note] if (note := engine_note(run, cells)) else []
    left_out = [cell.name for cell in cells_of(run) if cell.name not in {shown.name for shown in cells}]
    facts += [f"{name} not shown (inference unknown)" for name in left_out]
    lines = [f"{what}: {'end to end without inference' if metric != 'e2e' else 'end to end'}", ", ".join(facts)]
    return "\n".join(textwrap.fill(line, LINE_CHARS, break_on_hyphens=False) for line in lines)


def _axis_label(metric: str) -> str:
    return "e2e without inference (ms)" if metric == "e2e_without_inference" else "e2e, inference included (ms)"


def _label(cell: Cell) -> str:
    """Name a row by its cell, and by what travels where that is not said yet."""
    payload = cell.about["payload"]
    name = cell.name.replace("?", "\n?")
    return name if payload in {"none", ""} or payload in name else f"{name}\n({payload})"


def _part(cell: Cell, name: str) -> Floats:
    return cell.values_ms("residual") if name == "residual" else cell.group_ms(name)
