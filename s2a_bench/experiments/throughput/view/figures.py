"""The figures of a throughput run: rates with the paper's table II beside them, gaps, rates by position."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import engine_note
from s2a_bench.experiments.paper import paper_throughput
from s2a_bench.experiments.throughput.view.cells import (
    BIN,
    LLAMA_BENCH,
    RATIO_METRIC,
    Speed,
    reference_values,
    speeds_of,
)
from s2a_bench.stats import summarise, summary_of
from s2a_bench.writers.figures import LINE_CHARS, WIDE_SPREAD, logarithmic, name_rows, new_figure, write_beside
from s2a_bench.writers.style import GREY, cell_looks
from s2a_bench.writers.tables import mean_sd, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.store.run import Run

PAPER_LABEL = "the paper's claim (table II), other machines"
_REFERENCE_FILL = "#FFFFFF"


def build_throughput_bars(run: Run, *, against_paper: bool = False) -> Figure:
    """Draw mean ± sd of N / T_eval, a row a cell (the paper's table II), and llama-bench's decode rate where it ran.

    Bars from zero; points on a logarithmic axis where the rates are too far apart for one scale.
    """
    from matplotlib.patches import Patch

    speeds = [speed for speed in speeds_of(run) if speed.values("tokens_per_s").size]
    looks = cell_looks({speed.name: speed.cell.path for speed in speeds})
    rows = []
    for speed in speeds:
        found = summarise(speed.values("tokens_per_s"))
        rows.append((speed.name, found.mean, found.sd, mean_sd(found), looks[speed.name][0]))
    if reference := reference_values(run):
        found = summarise(reference)
        rows.append((f"{LLAMA_BENCH}\n(decode)", found.mean, found.sd, mean_sd(found), _REFERENCE_FILL))
    if against_paper:
        rows += [
            (f"paper:\n{claim.name}", claim.tokens_per_s, None, f"{claim.tokens_per_s:g}", GREY)
            for claim in paper_throughput()
        ]
    figure = new_figure(0.75 + 0.34 * len(rows) + (0.2 if against_paper else 0), _title(run, speeds, "Tokens a second"))
    axes = figure.subplots()
    means = [mean for _, mean, *_ in rows]
    wide = max(means) > WIDE_SPREAD * min(means)
    for place, (_, mean, sd, text, colour) in enumerate(rows):
        if wide:
            axes.plot(mean, place, "o", markersize=5, color=colour, markeredgecolor="black", markeredgewidth=0.5)
        else:
            axes.barh(place, mean, 0.62, color=colour, edgecolor="black", linewidth=0.5)
        if sd is not None:
            low = min(sd, mean * 0.999)  # a rate is above zero, whatever the standard deviation is
            axes.errorbar(mean, place, xerr=[[low], [sd]], color="black", capsize=2, linewidth=0.8)
        write_beside(axes, place, text)
    name_rows(axes, [name for name, *_ in rows])
    if wide:
        logarithmic(axes, max(means) / min(means))
        axes.set_xlim(min(means) / 2, max(means) * 2)
        axes.grid(visible=True, axis="x", linewidth=0.3, color="#DDDDDD")
    else:
        axes.set_xlim(left=0)
    axes.set_xlabel("tokens/s")
    if against_paper:
        handle = Patch(facecolor=GREY, edgecolor="black", linewidth=0.5, label=PAPER_LABEL)
        figure.legend(handles=[handle], loc="outside lower left")
    return figure


def build_gap_distribution(run: Run) -> Figure:
    """Draw the empirical distribution of the gaps between tokens, a line a cell."""
    speeds = [speed for speed in speeds_of(run) if speed.cell.itl_ms().size]
    looks = cell_looks({speed.name: speed.cell.path for speed in speeds})
    what = "Gaps between tokens, as the client saw them"
    figure = new_figure(2.35 + 0.14 * -(-len(speeds) // 2), _title(run, speeds, what))
    axes = figure.subplots()
    every: list[Floats] = [speed.cell.itl_ms() for speed in speeds]
    for speed, gaps in zip(speeds, every, strict=True):
        colour, line = looks[speed.name]
        axes.ecdf(gaps, label=f"{speed.name}, p99 {number(summarise(gaps).p99)} ms", color=colour, linestyle=line)
    low, high = min(gaps.min() for gaps in every), max(gaps.max() for gaps in every)
    if low > 0 and high > WIDE_SPREAD * low:
        logarithmic(axes, high / low)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel("share of gaps")
    axes.set_xlabel("gap (ms)")
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=1)
    return figure


def build_rate_by_position(run: Run) -> Figure:
    """Draw the decode rate over the place in the answer, median and a band from the lower to the upper quartile.

    Not means: tokens that arrive together after a pause have any rate at all.
    """
    import numpy as np

    speeds = [speed for speed in speeds_of(run) if speed.by_position()]
    looks = cell_looks({speed.name: speed.cell.path for speed in speeds})
    figure = new_figure(
        2.2 + 0.14 * -(-len(speeds) // 2), _title(run, speeds, f"Decode rate by position, bins of {BIN}: medians")
    )
    axes = figure.subplots()
    highest = 0.0
    for speed in speeds:
        found = speed.by_position()
        middles = [(first + last) / 2 + 1 for first, last in found]
        low, medians, high = np.array([np.percentile(rates, (25, 50, 75)) for rates in found.values()]).T
        colour, line = looks[speed.name]
        highest = max(highest, *medians)
        axes.plot(middles, medians, color=colour, linestyle=line, marker="o", markersize=3, label=speed.name)
        axes.fill_between(middles, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.5 * highest)
    axes.set_xlabel("token of the answer")
    axes.set_ylabel("tokens/s")
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.2)
    return figure


def throughput_figures(run: Run, *, against_paper: bool = False) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name; the paper's values only when asked for. No rates, no figures."""
    if not any(speed.values(RATIO_METRIC).size for speed in speeds_of(run)):
        return {}
    return {
        "throughput_bars": lambda: build_throughput_bars(run, against_paper=against_paper),
        "gaps": lambda: build_gap_distribution(run),
        "positions": lambda: build_rate_by_position(run),
    }


def _title(run: Run, speeds: list[Speed], what: str) -> str:
    """Return what is drawn, from how many requests of how many tokens, and what did not really answer."""
    counts = sorted({speed.cell.n for speed in speeds})
    facts = [f"n = {' to '.join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))} a cell"]
    tokens = summary_of(speeds[0].values("tokens"))
    facts += [f"{tokens.median:.0f} tokens an answer"] if tokens else []
    facts += sorted({speed.cell.about["size"] for speed in speeds})
    facts += [note] if (note := engine_note(run, [speed.cell for speed in speeds])) else []
    lines = [what, ", ".join(facts)]
    return "\n".join(textwrap.fill(line, LINE_CHARS, break_on_hyphens=False) for line in lines)
