"""The tables of a throughput run for people, and for programs as CSV."""

from __future__ import annotations

from dataclasses import astuple
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.as_csv import RATIOS
from s2a_bench.experiments.latency.view.cells import engine_note
from s2a_bench.experiments.latency.view.tables import launches_note
from s2a_bench.experiments.throughput.view.cells import (
    BIN,
    LLAMA_BENCH,
    METRICS,
    RATIO_METRIC,
    Speed,
    every_ratio_of,
    ratios_of,
    reference_depths,
    reference_values,
    speeds_of,
)
from s2a_bench.stats import summarise, summary_of
from s2a_bench.writers.csv_text import SUMMARY, CsvTable, summary_values
from s2a_bench.writers.tables import ABSENT, TextTable, interval, mean_sd, number

if TYPE_CHECKING:
    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.store.run import Run


def speed_table(run: Run) -> TextTable:
    """Lay out the rates: the paper's, what the client saw, and the ratios."""
    speeds = speeds_of(run)
    reference = reference_values(run)
    found = {(of, to): ratio for of, to, ratio in ratios_of(run, speeds)}
    bases = list(dict.fromkeys(to for _, to in found))
    joule = any(speed.values("tokens_per_joule").size for speed in speeds)
    rows = []
    for speed in speeds:
        row = [speed.name, str(speed.cell.n), str(speed.cell.errors)]
        row += [_mean(speed.values("tokens_per_s")), _mean(speed.values(RATIO_METRIC))]
        row += [_mean(speed.values("tokens_per_joule"))] if joule else []
        rows.append((*row, *("1" if speed.name == base else interval(found.get((speed.name, base))) for base in bases)))
    if reference:
        summary = summarise(reference)
        row = [LLAMA_BENCH, str(summary.n), "0", ABSENT, mean_sd(summary)]
        row += [ABSENT] if joule else []
        rows.append((*row, *("1" if base == LLAMA_BENCH else ABSENT for base in bases)))
    header: tuple[str, ...] = ("cell", "n", "errors", "N / T_eval", "decode")
    header += ("tokens/J",) if joule else ()
    return TextTable(
        "Tokens a second: mean ± sd" + ("; ratios of decode medians [95 % interval]" if bases else ""),
        (*header, *(f"ratio to {base}" for base in bases)),
        rows,
        1,
        frozenset({len(speeds)}) if reference else frozenset(),
        _notes(run, speeds),
    )


def prompt_table(run: Run) -> TextTable:
    """Lay out what happens before the first token, part by part, and the step after it: medians."""
    metrics = (
        *("prompt_tokens", "preprocess_ms", "vision_encode_ms", "prompt_eval_ms", "prompt_ms"),
        *("prefill_tokens_per_s", "first_decode_ms", "ttft_ms"),
    )
    rows = []
    for speed in speeds_of(run):
        p99 = summary_of(speed.values("ttft_ms"))
        row = [_median(speed.values(metric)) for metric in metrics]
        rows.append((speed.name, *row, number(p99.p99) if p99 else ABSENT))
    header = (
        "cell",
        *("tokens", "preprocess", "vision encode", "prefill", "all", "tokens/s", "1st decode"),
        "TTFT",
        "p99",
    )
    return TextTable("The prompt and the first step after it: medians, in ms", header, rows, 1)


def gap_table(run: Run) -> TextTable:
    """Lay out the gaps between tokens, each gap of each request."""
    rows = []
    for speed in speeds_of(run):
        gaps = speed.cell.itl_ms()
        summary = summary_of(gaps)
        values = (
            [mean_sd(summary), number(summary.median), number(summary.p90), number(summary.p99), number(gaps.max())]
            if summary
            else [ABSENT] * 5
        )
        rows.append((speed.name, str(gaps.size), *values))
    header = ("cell", "gaps", "mean ± sd", "median", "p90", "p99", "max")
    return TextTable("Between two tokens, as the client saw them, in ms", header, rows, 1)


def position_table(run: Run) -> TextTable | None:
    """Lay out the decode rate by the place in the answer; None where all answers end in the first bin."""
    speeds = speeds_of(run)
    found = {speed.name: speed.by_position() for speed in speeds}
    bins = sorted({place for rates in found.values() for place in rates})
    if len(bins) < 2:  # noqa: PLR2004 - one bin is the whole answer, which stands elsewhere
        return None
    rows = [
        (f"{first + 1}-{last + 1}", *(_median(found[speed.name].get((first, last))) for speed in speeds))
        for first, last in bins
    ]
    header = ("token", *(speed.name for speed in speeds))
    return TextTable(f"Decode tokens a second by position, bins of {BIN}: medians", header, rows, 1)


def throughput_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name."""
    tables = {"throughput": speed_table(run), "prompt": prompt_table(run), "gaps": gap_table(run)}
    if positions := position_table(run):
        tables["positions"] = positions
    return tables


def throughput_csv(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table, every digit kept; what is absent has no row."""
    speeds = speeds_of(run)
    summaries = [
        (speed.name, metric, *summary_values(summary), speed.cell.emulated)
        for speed in speeds
        for metric, values in [*((name, speed.values(name)) for name in METRICS), ("itl_ms", speed.cell.itl_ms())]
        if (summary := summary_of(values))
    ]
    if reference := reference_values(run):
        summaries.append((LLAMA_BENCH, RATIO_METRIC, *summary_values(summarise(reference)), False))
    positions = [
        (speed.name, first, last, *summary_values(summarise(rates)), speed.cell.emulated)
        for speed in speeds
        for (first, last), rates in speed.by_position().items()
    ]
    emulated = any(speed.cell.emulated for speed in speeds)  # one engine answers in all cells of a run
    ratios = [(*names, *astuple(ratio), emulated) for *names, ratio in every_ratio_of(run, speeds)]
    return {
        "throughput.csv": CsvTable.of(("cell", "metric", *SUMMARY, "emulated"), summaries),
        "positions.csv": CsvTable.of(("cell", "first", "last", *SUMMARY, "emulated"), positions),
        "ratios.csv": CsvTable.of(RATIOS, ratios),
    }


def _notes(run: Run, speeds: list[Speed]) -> tuple[str, ...]:
    """Return what a reader must know besides the numbers."""
    untold = [speed.name for speed in speeds if not speed.told]
    notes = ["N / T_eval is the engine's own figure, as in the paper."] if len(untold) < len(speeds) else []
    notes.append("decode is (n - 1) / (t_last - t_first) at the client.")
    if untold:
        notes.append(f"{', '.join(untold)}: the server does not tell T_eval, so decode stands in for N / T_eval.")
    facts = sorted({speed.cell.about["size"] for speed in speeds})
    if sampling := (run.manifest.get("model") or {}).get("sampling"):
        facts.append(f"sampling of our engine: {sampling}")
    notes.append(f"{', '.join(facts)}.")
    if note := launches_note(ratio for _, _, ratio in ratios_of(run, speeds)):
        notes.append(note)
    if note := engine_note(run, [speed.cell for speed in speeds]):
        notes.append(note.sentence())
    if depths := reference_depths(run):
        notes.append(
            f"{LLAMA_BENCH} decodes behind {', '.join(map(str, depths))} tokens, as our requests do; "
            "it samples nothing and writes no text."
        )
    if joined := sum(speed.joined for speed in speeds):
        notes.append(f"{joined} tokens came together with another one: gaps are between arrivals.")
    if failed := sum(speed.cell.errors for speed in speeds):
        notes.append(f"{failed} requests failed and are in no number here; samples.csv says why.")
    return tuple(notes)


def _mean(values: Floats | None) -> str:
    summary = None if values is None else summary_of(values)
    return mean_sd(summary) if summary else ABSENT


def _median(values: Floats | None) -> str:
    summary = None if values is None else summary_of(values)
    return number(summary.median) if summary else ABSENT
