"""The tables and figures of a throughput run: rates, the prompt, gaps, rates by position."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.columns import known
from s2a_bench.experiments.references import bars_of
from s2a_bench.experiments.requests import OF_ANSWERS, launches_note
from s2a_bench.experiments.throughput.metrics import (
    BIN,
    ENGINE_METRIC,
    LLAMA_BENCH,
    RATIO_METRIC,
    ThroughputCells,
    joined,
    rates_by_position,
    throughput_cells,
    throughput_csv,
    throughput_json,
)
from s2a_bench.stats import Floats, summary_of
from s2a_bench.writers.figures import WHISKERS, Bar, build_bars, build_distribution, new_figure
from s2a_bench.writers.style import cell_styles
from s2a_bench.writers.tables import ABSENT, MEAN_SD, TextTable, entries, interval, mean_sd, median_mean, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_REFERENCE_FILL: Final = "#FFFFFF"


def show(run: StoredRun, *, against: str = "", **_: Any) -> Shown:
    cells = throughput_cells(run)
    return Shown.build(
        sentences=lambda: throughput_sentences(cells),
        tables={
            "throughput": lambda: speed_table(cells),
            "prompt": lambda: _prompt_table(cells),
            "gaps": lambda: _gap_table(cells),
            "positions": lambda: position_table(cells),
        },
        main=["throughput", "prompt"],
        csvs=lambda: throughput_csv(cells),
        figures=lambda: throughput_figures(cells, against),
        json=lambda: throughput_json(cells),
    )


def throughput_sentences(cells: ThroughputCells) -> list[str]:
    sentences = [
        f"{cell.name}: {mean_sd(rates)} tokens/s, {'by its own figure' if cell.has_engine_time else 'at the client'}."
        for cell in cells
        if (rates := summary_of(cell.values(ENGINE_METRIC)))
    ]
    sentences += [
        f"By their own figures the engine of {of} has {interval(ratio)} of the rate of {to}."
        for metric, of, to, ratio in cells.rate_ratios
        if metric == ENGINE_METRIC
    ]
    return sentences or ["No request was answered; samples.csv says why."]


def speed_table(cells: ThroughputCells) -> TextTable:
    reference = cells.reference_values
    ratios = {(of, to): ratio for metric, of, to, ratio in cells.rate_ratios if metric == RATIO_METRIC}
    bases = list(dict.fromkeys(to for _, to in ratios))
    metrics = [ENGINE_METRIC, RATIO_METRIC]
    metrics += ["tokens_per_joule"] if cells.having("tokens_per_joule") else []
    rows: list[tuple[str, ...]] = [
        (
            *(cell.name, str(cell.n), str(cell.errors)),
            *(median_mean(cell.values(metric)) for metric in metrics),
            *("1" if cell.name == base else interval(ratios.get((cell.name, base))) for base in bases),
        )
        for cell in cells
    ]
    if reference.size:
        rates = (ABSENT, median_mean(reference), ABSENT)[: len(metrics)]
        over = ("1" if base == LLAMA_BENCH else ABSENT for base in bases)
        rows.append((LLAMA_BENCH, str(len(reference)), "0", *rates, *over))
    return TextTable(
        "Tokens a second: median (mean ± sd)" + ("; ratios of decode medians [95 % interval]" if bases else ""),
        ("cell", "n", "errors", *(OF_ANSWERS[name].title for name in metrics), *(f"ratio to {base}" for base in bases)),
        rows,
        1,
        frozenset({len(cells)}) if reference.size else frozenset(),
        (*_notes(cells, launches_note(ratios.values())), *cells.failure_notes("requests")),
    )


def _prompt_table(cells: ThroughputCells) -> TextTable:
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
        for cell in cells
    ]
    header = ("cell", *(OF_ANSWERS[name].title for name in columns), "p99")
    return TextTable("The prompt and the first step after it: medians, in ms", header, rows, 1)


def _gap_table(cells: ThroughputCells) -> TextTable:
    rows = []
    for cell in cells:
        gaps = cell.values("itl")
        longest = number(gaps.max()) if gaps.size else ABSENT
        rows.append((cell.name, str(gaps.size), *entries(gaps, MEAN_SD, "median", "p90", "p99"), longest))
    header = ("cell", "gaps", "mean ± sd", "median", "p90", "p99", "max")
    return TextTable("Between two tokens, as the client saw them, in ms", header, rows, 1)


def position_table(cells: ThroughputCells) -> TextTable | None:
    """Return the table of decode rates by position in the answer; None if all answers end in the first bin."""
    by_cell = {cell.name: rates_by_position(cell) for cell in cells}
    bins = sorted({place for rates in by_cell.values() for place in rates})
    if len(bins) < 2:  # noqa: PLR2004 - one bin is the whole answer, which has a table
        return None
    rows: list[tuple[str, ...]] = [
        (
            f"{place[0] + 1}-{place[1] + 1}",
            *(entries(rates[place], "median")[0] if place in rates else ABSENT for rates in by_cell.values()),
        )
        for place in bins
    ]
    return TextTable(f"Decode tokens a second by position, bins of {BIN}: medians", ("token", *by_cell), rows, 1)


def _notes(cells: ThroughputCells, launches: tuple[str, ...]) -> list[str]:
    without_time = [cell.name for cell in cells if not cell.has_engine_time]
    notes = ["N / T_eval is the engine's own figure, as in the paper."] if len(without_time) < len(cells) else []
    notes.append("decode is (n - 1) / (t_last - t_first) at the client.")
    if without_time:
        notes.append(f"{', '.join(without_time)}: the server does not report T_eval; decode stands in for N / T_eval.")
    facts = sorted({cell.about["size"] for cell in cells})
    if sampling := (cells.run.manifest.get("model") or {}).get("sampling"):
        facts.append(f"sampling of our engine: {sampling}")
    notes += [f"{', '.join(facts)}.", *launches, *cells.engine_notes]
    if depths := cells.reference_depths:
        notes.append(
            f"{LLAMA_BENCH} decodes after {', '.join(map(str, depths))} tokens, as our requests do, "
            "without sampling or text."
        )
    if together := sum(map(joined, cells)):
        notes.append(f"{together} tokens arrived together with another one: gaps are between arrivals.")
    return notes


def throughput_figures(cells: ThroughputCells, against: str = "") -> dict[str, Callable[[], Figure]]:
    if not cells.having(RATIO_METRIC):
        return {}

    def bars() -> Figure:
        """Draw medians of N / T_eval, a row a cell (the paper's table II), and llama-bench's decode rate.

        Bars from zero; points on a logarithmic axis if the rates differ too much.
        """
        drawn = cells.having(ENGINE_METRIC)
        styles = _styles(drawn)
        bars = [Bar.of(cell.name, cell.values(ENGINE_METRIC), styles[cell.name][0]) for cell in drawn]
        if (reference := cells.reference_values).size:
            bars.append(Bar.of(f"{LLAMA_BENCH}\n(decode)", reference, _REFERENCE_FILL))
        others = bars_of(against, "throughput_bars")
        caption = _caption(drawn, "Tokens a second, medians", WHISKERS, *others.notes)
        return build_bars(caption, [*bars, *others.bars], "tokens/s", others.label, scaled=True)

    def gaps() -> Figure:
        drawn = cells.having("itl")
        lines, styles = {}, _styles(drawn)
        for cell in drawn:
            values = cell.values("itl")
            lines[f"{cell.name}, p99 {entries(values, 'p99')[0]} ms"] = values, styles[cell.name]
        caption = _caption(drawn, "Gaps between tokens, as the client saw them")
        return build_distribution(caption, lines, "gaps", "gap (ms)", columns=1)

    def positions() -> Figure:
        by_cell = {cell.name: rates_by_position(cell) for cell in cells}
        drawn = cells.only(cell for cell in cells if by_cell[cell.name])
        rates = {cell.name: by_cell[cell.name] for cell in drawn}
        caption = _caption(drawn, f"Decode rate by position, bins of {BIN}: medians", "Bands: quartiles.")
        return build_rate_by_position(caption, rates, _styles(drawn))

    return {"throughput_bars": bars, "gaps": gaps, "positions": positions}


def build_rate_by_position(
    caption: Sequence[str],
    rates: Mapping[str, Mapping[tuple[int, int], Floats]],
    styles: Mapping[str, tuple[str, str]],
) -> Figure:
    """Draw decode rates, cell -> first and last token -> rates: median, and a band of the quartiles.

    Not means: the rate of tokens that arrive together after a pause is arbitrary.
    """
    figure = new_figure(2.2 + 0.14 * -(-len(rates) // 2), caption)
    axes = figure.subplots()
    highest = 0.0
    for name, by_position in rates.items():
        middles = [(first + last) / 2 + 1 for first, last in by_position]
        low, medians, high = np.array([np.percentile(each, (25, 50, 75)) for each in by_position.values()]).T
        colour, line = styles[name]
        highest = max(highest, *medians)
        axes.plot(middles, medians, color=colour, linestyle=line, marker="o", markersize=3, label=name)
        axes.fill_between(middles, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.5 * highest)
    axes.set_xlabel("token of the answer")
    axes.set_ylabel("tokens/s")
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.2)
    return figure


def _styles(cells: ThroughputCells) -> dict[str, tuple[str, str]]:
    return cell_styles({cell.name: cell.path for cell in cells})


def _caption(cells: ThroughputCells, what: str, *notes: str) -> tuple[str, ...]:
    tokens = summary_of(known(cells[0].n_tokens))
    facts = [f"{tokens.median:.0f} tokens an answer"] if tokens else []
    return cells.caption(what, [*facts, *sorted({cell.about["size"] for cell in cells})], notes)
