"""The tables and figures of a throughput run: rates, the prompt, gaps, rates by position."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.references import bars_of
from s2a_bench.experiments.requests import (
    OF_ANSWERS,
    RequestCell,
    caption_for,
    engine_notes,
    failure_notes,
    launches_note,
    span_of,
)
from s2a_bench.experiments.throughput.metrics import (
    BIN,
    ENGINE_METRIC,
    LLAMA_BENCH,
    RATIO_METRIC,
    joined,
    rates_by_position,
    ratios_of,
    reference_depths,
    reference_values,
    throughput_cells,
    throughput_csv,
    throughput_json,
)
from s2a_bench.stats import summary_of
from s2a_bench.writers.figures import WHISKERS, Bar, build_bars, build_distribution, new_figure
from s2a_bench.writers.style import cell_styles
from s2a_bench.writers.tables import ABSENT, MEAN_SD, TextTable, entries, interval, mean_sd, median_mean, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_REFERENCE_FILL: Final = "#FFFFFF"


def show(run: StoredRun, *, against: str = "", **_: Any) -> Shown:
    return Shown.build(
        sentences=lambda: throughput_sentences(run),
        tables={
            "throughput": lambda: speed_table(run),
            "prompt": lambda: _prompt_table(run),
            "gaps": lambda: _gap_table(run),
            "positions": lambda: position_table(run),
        },
        main=["throughput", "prompt"],
        csvs=lambda: throughput_csv(run),
        figures=lambda: throughput_figures(run, against),
        json=lambda: throughput_json(run),
    )


def throughput_sentences(run: StoredRun) -> list[str]:
    sentences, cells = [], throughput_cells(run)
    for cell in cells:
        if found := summary_of(cell.values(ENGINE_METRIC)):
            source = "the engine's own figure" if cell.has_engine_time else "as the client saw it"
            times = span_of([found.n], "request")
            sentences.append(f"{cell.name}: {mean_sd(found)} tokens/s (mean ± sd of {times}, {source}).")
    sentences += [
        f"By their own figures the engine of {of} has {interval(ratio)} of the rate of {to}."
        for metric, of, to, ratio in ratios_of(run, cells)
        if metric == ENGINE_METRIC
    ]
    return sentences or ["No request was answered; samples.csv says why."]


def speed_table(run: StoredRun) -> TextTable:
    cells = throughput_cells(run)
    reference = reference_values(run)
    ratios = {(of, to): ratio for metric, of, to, ratio in ratios_of(run, cells) if metric == RATIO_METRIC}
    bases = list(dict.fromkeys(to for _, to in ratios))
    metrics = [ENGINE_METRIC, RATIO_METRIC]
    metrics += ["tokens_per_joule"] if any(cell.values("tokens_per_joule").size for cell in cells) else []
    rows: list[tuple[str, ...]] = [
        (
            *(cell.name, str(cell.n), str(cell.errors)),
            *(median_mean(cell.values(metric)) for metric in metrics),
            *("1" if cell.name == base else interval(ratios.get((cell.name, base))) for base in bases),
        )
        for cell in cells
    ]
    if reference:
        rates = (ABSENT, median_mean(np.array(reference)), ABSENT)[: len(metrics)]
        over = ("1" if base == LLAMA_BENCH else ABSENT for base in bases)
        rows.append((LLAMA_BENCH, str(len(reference)), "0", *rates, *over))
    return TextTable(
        "Tokens a second: median (mean ± sd)" + ("; ratios of decode medians [95 % interval]" if bases else ""),
        ("cell", "n", "errors", *(OF_ANSWERS[name].title for name in metrics), *(f"ratio to {base}" for base in bases)),
        rows,
        1,
        frozenset({len(cells)}) if reference else frozenset(),
        (*_notes(run, cells, launches_note(ratios.values())), *failure_notes(cells, "requests")),
    )


def _prompt_table(run: StoredRun) -> TextTable:
    columns = (
        *("prompt_tokens", "preprocess_ms", "vision_encode_ms", "prompt_eval_ms", "prompt_ms"),
        *("prefill_tokens_per_s", "first_decode_ms", "ttft_ms"),
    )
    rows: list[tuple[str, ...]] = [
        (
            cell.name,
            *(entries(cell.values(metric), "median")[0] for metric in columns),
            *entries(cell.values("ttft_ms"), "p99"),
        )
        for cell in throughput_cells(run)
    ]
    header = ("cell", *(OF_ANSWERS[name].title for name in columns), "p99")
    return TextTable("The prompt and the first step after it: medians, in ms", header, rows, 1)


def _gap_table(run: StoredRun) -> TextTable:
    rows = []
    for cell in throughput_cells(run):
        gaps = cell.values("itl")
        longest = number(gaps.max()) if gaps.size else ABSENT
        rows.append((cell.name, str(gaps.size), *entries(gaps, MEAN_SD, "median", "p90", "p99"), longest))
    header = ("cell", "gaps", "mean ± sd", "median", "p90", "p99", "max")
    return TextTable("Between two tokens, as the client saw them, in ms", header, rows, 1)


def position_table(run: StoredRun) -> TextTable | None:
    """Return the table of decode rates by position in the answer; None if all answers end in the first bin."""
    found = {cell.name: rates_by_position(cell) for cell in throughput_cells(run)}
    bins = sorted({place for rates in found.values() for place in rates})
    if len(bins) < 2:  # noqa: PLR2004 - one bin is the whole answer, which has a table
        return None
    rows: list[tuple[str, ...]] = [
        (
            f"{place[0] + 1}-{place[1] + 1}",
            *(entries(rates[place], "median")[0] if place in rates else ABSENT for rates in found.values()),
        )
        for place in bins
    ]
    return TextTable(f"Decode tokens a second by position, bins of {BIN}: medians", ("token", *found), rows, 1)


def _notes(run: StoredRun, cells: list[RequestCell], launches: tuple[str, ...]) -> list[str]:
    without_time = [cell.name for cell in cells if not cell.has_engine_time]
    notes = ["N / T_eval is the engine's own figure, as in the paper."] if len(without_time) < len(cells) else []
    notes.append("decode is (n - 1) / (t_last - t_first) at the client.")
    if without_time:
        notes.append(f"{', '.join(without_time)}: the server does not report T_eval; decode stands in for N / T_eval.")
    facts = sorted({cell.about["size"] for cell in cells})
    if sampling := (run.manifest.get("model") or {}).get("sampling"):
        facts.append(f"sampling of our engine: {sampling}")
    notes += [f"{', '.join(facts)}.", *launches, *engine_notes(run, cells)]
    if depths := reference_depths(run):
        notes.append(
            f"{LLAMA_BENCH} decodes after {', '.join(map(str, depths))} tokens, as our requests do, "
            "without sampling or text."
        )
    if together := sum(map(joined, cells)):
        notes.append(f"{together} tokens arrived together with another one: gaps are between arrivals.")
    return notes


def throughput_figures(run: StoredRun, against: str = "") -> dict[str, Callable[[], Figure]]:
    if not any(cell.values(RATIO_METRIC).size for cell in throughput_cells(run)):
        return {}
    return {
        "throughput_bars": lambda: build_throughput_bars(run, against),
        "gaps": lambda: build_gap_distribution(run),
        "positions": lambda: build_rate_by_position(run),
    }


def build_throughput_bars(run: StoredRun, against: str = "") -> Figure:
    """Draw medians of N / T_eval, a row a cell (the paper's table II), and llama-bench's decode rate.

    Bars from zero; points on a logarithmic axis if the rates differ too much.
    """
    cells = [cell for cell in throughput_cells(run) if cell.values(ENGINE_METRIC).size]
    styles = cell_styles({cell.name: cell.path for cell in cells})
    bars = [Bar.of(cell.name, cell.values(ENGINE_METRIC), styles[cell.name][0]) for cell in cells]
    if reference := reference_values(run):
        bars.append(Bar.of(f"{LLAMA_BENCH}\n(decode)", np.array(reference), _REFERENCE_FILL))
    others = bars_of(against, "throughput_bars")
    caption = _caption(run, cells, "Tokens a second, medians", WHISKERS, *others.notes)
    return build_bars(caption, [*bars, *others.bars], "tokens/s", others.label, scaled=True)


def build_gap_distribution(run: StoredRun) -> Figure:
    cells = [cell for cell in throughput_cells(run) if cell.values("itl").size]
    styles = cell_styles({cell.name: cell.path for cell in cells})
    lines = {
        f"{cell.name}, p99 {entries(gaps, 'p99')[0]} ms": (gaps, styles[cell.name])
        for cell in cells
        for gaps in [cell.values("itl")]
    }
    caption = _caption(run, cells, "Gaps between tokens, as the client saw them")
    return build_distribution(caption, lines, "gaps", "gap (ms)", columns=1)


def build_rate_by_position(run: StoredRun) -> Figure:
    """Draw the decode rate over the position in the answer: median, and a band of the quartiles.

    Not means: the rate of tokens that arrive together after a pause is arbitrary.
    """
    cells = [cell for cell in throughput_cells(run) if rates_by_position(cell)]
    styles = cell_styles({cell.name: cell.path for cell in cells})
    caption = _caption(run, cells, f"Decode rate by position, bins of {BIN}: medians", "Bands: quartiles.")
    figure = new_figure(2.2 + 0.14 * -(-len(cells) // 2), caption)
    axes = figure.subplots()
    highest = 0.0
    for cell in cells:
        found = rates_by_position(cell)
        middles = [(first + last) / 2 + 1 for first, last in found]
        low, medians, high = np.array([np.percentile(rates, (25, 50, 75)) for rates in found.values()]).T
        colour, line = styles[cell.name]
        highest = max(highest, *medians)
        axes.plot(middles, medians, color=colour, linestyle=line, marker="o", markersize=3, label=cell.name)
        axes.fill_between(middles, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.5 * highest)
    axes.set_xlabel("token of the answer")
    axes.set_ylabel("tokens/s")
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.2)
    return figure


def _caption(run: StoredRun, cells: list[RequestCell], what: str, *notes: str) -> tuple[str, ...]:
    tokens = summary_of(cells[0].n_tokens.to_numpy(dtype="float64"))
    facts = [f"{tokens.median:.0f} tokens an answer"] if tokens else []
    return caption_for(run, cells, what, [*facts, *sorted({cell.about["size"] for cell in cells})], notes)
