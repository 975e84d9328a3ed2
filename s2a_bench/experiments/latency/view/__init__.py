"""The sentences, tables and figures of a latency run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

import pandas as pd

from s2a_bench.experiments import Shown
from s2a_bench.experiments.columns import NS_PER_MS, known
from s2a_bench.experiments.latency.metrics import AROUND, METRICS, latency_csv, latency_json
from s2a_bench.experiments.latency.view.figures import latency_figures
from s2a_bench.experiments.requests import (
    GROUP,
    ITL,
    TOKEN_DELAY,
    Ends,
    RequestCell,
    RequestCells,
    cells_of,
    launches_note,
    metric_phrase,
    span_of,
)
from s2a_bench.stats import Floats, Ratio, summary_of
from s2a_bench.store.run import StoredRun
from s2a_bench.trace import RESIDUAL_LIMIT
from s2a_bench.transport import declared_transport
from s2a_bench.writers.tables import ABSENT, MEAN_SD, TextTable, ends_entries, entries, interval, median_mean, number


def show(run: StoredRun, *, against: str = "", **_: Any) -> Shown:
    cells = cells_of(run)
    modelled = cells.having("e2e_without_model")
    return Shown.build(
        sentences=lambda: _latency_sentences(cells),
        tables={
            "summary": lambda: summary_table(cells),
            "summary-e2e": lambda: summary_table(cells, "e2e"),
            "summary-model": lambda: summary_table(cells, "e2e_without_model") if modelled else None,
            "stages": lambda: stage_table(cells),
            "tokens": lambda: _token_table(cells),
            "frames": lambda: _frame_table(cells),
            "facts": lambda: fact_table(cells),
        },
        main=["stages", "summary", "summary-model"],
        csvs=lambda: latency_csv(cells),
        figures=lambda: latency_figures(cells, against),
        json=lambda: latency_json(cells),
    )


def _latency_sentences(cells: RequestCells) -> list[str]:
    """Return how many times as long cells take as another, in process if there is no other; else their medians."""
    metric = "e2e_without_inference" if cells.having("e2e_without_inference") else "e2e"
    by_base: dict[tuple[bool, str, str], list[tuple[RequestCell, RequestCell, Ratio]]] = {}
    for of, cell, base, ratio in cells.ratios:
        if ratio.value is not None and (of == metric or (of == "e2e_without_model" and cell.has_ingest)):
            key = declared_transport(base.pipeline).in_process, of, base.name
            by_base.setdefault(key, []).append((cell, base, ratio))
    wired = {key: pairs for key, pairs in by_base.items() if not key[0]} or by_base
    sentences = [
        f"{of.replace('_', ' ').removeprefix('e2e ').capitalize()}, {_difference(pairs)}"
        for (_, of, _), pairs in wired.items()
    ]
    if not sentences:
        medians = (f"{cell.label}{_of(cell.payload)} {entries(cell.values(metric), 'median')[0]}" for cell in cells)
        sentences = [f"{metric_phrase(metric)}, medians in ms: {', '.join(medians)}."] if cells else []
    return [*sentences, *launches_note(ratio for pairs in wired.values() for *_, ratio in pairs)]


def _difference(pairs: Sequence[tuple[RequestCell, RequestCell, Ratio]]) -> str:
    """Say how many times as long cells take as their base; an interval that holds 1 shows no difference."""
    cell, base, _ = pairs[0]
    than = f"{base.label}{_of(base.payload or cell.payload)}"
    differ: list[str] = []
    same: list[str] = []
    for cell, _, ratio in sorted(pairs, key=lambda pair: -(pair[2].value or 0)):
        name = cell.label + ("" if cell.payload == base.payload else _of(cell.payload))
        is_same = ratio.ci95 and ratio.ci95[0] <= 1 <= ratio.ci95[1]
        times = "" if differ or is_same else f" times as long as {than}"
        (same if is_same else differ).append(f"{name}{' takes' if times else ''} {interval(ratio)}{times}")
    none = f"no difference {'' if differ else f'from {than} '}is shown for {', '.join(same)}" if same else ""
    return f"{'; '.join(filter(None, (', '.join(differ), none)))}.".replace("[", "[95 %: ", 1)


def _of(payload: str) -> str:
    return f" ({payload})" if payload else ""


_FOOT = ("residual", "round_trip", "e2e_without_inference", "preprocess", "e2e_without_model", "inference", "e2e")
_HEADINGS = {"preprocess": "preproc.", "inference": "infer.", **{metric.name: metric.title for metric in METRICS}}

_FRAME_FOOT = {
    "residual": "residual",
    "path": "frame path",
    "latency": "frame path from the intended time",
}


def stage_table(cells: RequestCells) -> TextTable:
    """Return the table of the stages in path order, a column a cell; the brief one has the cells as rows.

    Inference is below the residual, so that e2e without inference reads as one sum, and so do the rows below it.
    """
    rows: list[tuple[str, ...]] = []
    last = ""
    for stage in cells.stages:
        if (group := cells.run.stages[stage]) != "inference":
            rows.append(("" if group == last else group, stage, *(_entry(cell, stage, full=True) for cell in cells)))
            last = group
    below = len(rows)
    rows += [
        ("", metric.replace("_", " "), *(_entry(cell, metric, full=True) for cell in cells)) for metric in _foot(cells)
    ]
    title, header = "Stages in ms: median (mean ± sd)", ("group", "stage", *cells.titles)
    return TextTable(title, header, rows, 2, frozenset({below + 1}), _notes(cells), brief=group_table(cells))


def group_table(cells: RequestCells) -> TextTable:
    """Return a table with groups as columns and cells as rows."""
    groups = [group for group in cells.groups if group != "inference"]
    foot = _foot(cells)[1:]
    columns = [*(f"{GROUP}{group}" for group in groups), *foot]
    rows = [tuple(_entry(cell, column) for column in columns) for cell in cells]
    header = (*groups, *(_HEADINGS[metric] for metric in foot))
    return _by_cell("Groups of stages in ms: medians", header, cells, rows, _notes(cells))


def _by_cell(
    title: str,
    header: Sequence[str],
    cells: RequestCells,
    rows: Sequence[tuple[str, ...]],
    notes: Iterable[str],
) -> TextTable:
    if len(cells.payloads) < 2:  # noqa: PLR2004 - one payload, named by the notes
        named = [(cell.name, *row) for cell, row in zip(cells, rows, strict=True)]
        return TextTable(title, ("cell", *header), named, 1, notes=tuple(notes))
    blocks: dict[str, list[tuple[str, ...]]] = {}
    for cell, row in zip(cells, rows, strict=True):
        blocks.setdefault(cell.payload, []).append((cell.payload or ABSENT, cell.label, *row))
    names = (cell.name for payload in blocks for cell in cells if cell.payload == payload)
    return TextTable.grouped(title, ("payload", "cell", *header), blocks.values(), 2, notes, once=1, cells=names)


def summary_table(cells: RequestCells, metric: str = "e2e_without_inference") -> TextTable:
    ratios = {(cell.name, base.name): ratio for of, cell, base, ratio in cells.ratios if of == metric}
    bases: dict[str, list[RequestCell]] = {}
    for base in cells:
        if base.values(metric).size and any(cell.is_compared_with(base) for cell in cells):
            bases.setdefault(base.name if base.mixed else base.label, []).append(base)
    figures = (MEAN_SD, "median", "p90", "p99")
    around = AROUND if metric == "e2e_without_inference" else ()
    bounds = [each for each in around if cells.having(each)]
    rows = []
    over: list[Ratio] = []
    for cell in cells:
        texts = []
        for each in bases.values():
            ratio = next((ratios.get((cell.name, base.name)) for base in each if cell.is_compared_with(base)), None)
            over += [ratio] if ratio else []
            texts.append("1" if cell in each else interval(ratio))
        limits = (entries(cell.values(each), "median")[0] for each in bounds)
        rows.append((str(cell.n), str(cell.errors), *entries(cell.values(metric), *figures), *limits, *texts))
    header = ("n", "errors", *figures, *(each.title for each in bounds), *(f"ratio to {base}" for base in bases))
    title = f"{metric_phrase(metric)} in ms; ratios of medians [95 % interval]"
    return _by_cell(title, header, cells, rows, (*_notes(cells), *launches_note(over)))


def _token_table(cells: RequestCells) -> TextTable | None:
    """Return the table of gaps and delays of tokens; None if no server reports when they left the engine."""
    reported = cells.having(TOKEN_DELAY)
    if not reported:
        return None
    columns = ((ITL, ("median", "p99")), (TOKEN_DELAY, ("median", "p90", "p99")))
    header = [f"{metric.title} {statistic}" for metric, shown in columns for statistic in shown]
    rows = []
    for cell in reported:
        texts = []
        for metric, shown in columns:
            ends = cell.ends(metric)
            texts += ends_entries(ends, *shown) if ends.lo.size else entries(cell.values(metric), *shown)
        rows.append(tuple(texts))
    title = f"{cells.answer.capitalize()} in ms: from one to the next (gap), and engine to client (delay)"
    return _by_cell(title, header, reported, rows, reported.engine_notes)


def fact_table(cells: RequestCells) -> TextTable | None:
    rows = []
    for fact, meant in cells.run.facts.items():
        values = [known(cell.fact(fact)) for cell in cells]
        if any(each.size for each in values):
            medians = (number(median(each.tolist())) if each.size else ABSENT for each in values)
            rows.append((fact, meant["unit"], *medians))
    header = ("fact", "unit", *cells.titles)
    return TextTable("Facts: medians", header, rows, 2, notes=_notes(cells)) if rows else None


def _foot(cells: RequestCells) -> list[str]:
    """Return the rows below the stages; preprocessing and e2e without model only if reported."""
    optional = {"round_trip", "preprocess", "e2e_without_model"}
    return [name for name in _FOOT if name not in optional or cells.having(name)]


def _entry(cell: RequestCell, metric: str, *, full: bool = False) -> str:
    return _median(cell.values(metric), cell.ends(metric), full=full)


def _median(values: Floats, ends: Ends, *, full: bool = False) -> str:
    if ends.lo.size:
        return ends_entries(ends, "median")[0]
    return median_mean(values) if full else entries(values, "median")[0]


def _notes(cells: RequestCells) -> tuple[str, ...]:
    counts = span_of(cell.n for cell in cells)
    notes = [f"n = {counts} samples a cell, warm-ups left out." if counts else "No samples."]
    if cells:
        mode = cells[0].about["mode"]
        notes.append(f"{cells.observation}; payload: {', '.join(cells.payloads) or 'none'}; {mode} mode.")
    if shape := cells.action_shape:
        notes.append(f"Each answer is a chunk of {shape} numbers, not tokens.")
    notes += cells.engine_notes
    if any(cell.has_ingest for cell in cells):
        notes.append(
            "A llama-server's ingest slices and resizes the picture, which our engine counts as inference: compare e2e "
            "or e2e without model. Of a llama-server that is e2e less the prompt_ms it reports, which is assumed to be "
            "all of its model's time before the first token."
        )
    if errors_ms := [summary.median for cell in cells if (summary := summary_of(cell.values("clock_error")))]:
        notes.append(
            f"[lo, hi]: the server is on another host, whose clock is known to ± {number(max(errors_ms))} ms (median). "
            "What begins on one host and ends on the other lies in between; all other times are exact, and so is the "
            "round trip, network and return together."
        )
    if flagged := sum(cell.flagged() for cell in cells):
        notes.append(
            f"{flagged} of {sum(cell.n for cell in cells)} samples have a residual above {RESIDUAL_LIMIT:.0%}"
            " of e2e without inference."
        )
    return (*notes, *cells.failure_notes("samples"))


def _frame_table(cells: RequestCells) -> TextTable | None:
    """Return the table of the budget of frames with a prompt: medians in ms, a column a cell; None without frames."""
    frames = cells.run.frames
    if frames.empty:
        return None
    used = [frames[frames["used_by"].isin(cell.ids)] for cell in cells]
    rows = []
    for stage, group in cells.run.stages.items():
        entries_of = [_frame_entry(each, stage) for each in used]
        if any(entry != ABSENT for entry in entries_of):
            rows.append((group, stage, *entries_of))
    rule = len(rows)
    rows += [("", name, *(_frame_entry(each, column) for each in used)) for column, name in _FRAME_FOOT.items()]
    rows.append(("", "age when inference starts", *(_entry(cell, "frame_age") for cell in cells)))
    title = "Frame path in ms: medians over the frames that a prompt was about"
    return TextTable(title, ("group", "stage", *cells.titles), rows, 2, frozenset({rule + 1}))


def _frame_entry(frames: pd.DataFrame, column: str) -> str:
    none = frames["path_ns"].iloc[:0]
    columns = [frames.get(f"{column}{end}_ns", none).dropna() for end in ("", "_lo", "_hi")]
    exact, lo, hi = (each.to_numpy(dtype="float64") / NS_PER_MS for each in columns)
    return _median(exact, Ends(lo, hi))
