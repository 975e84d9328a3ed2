"""The tables of a run for people: text, rounded to three digits, as Markdown and LaTeX."""

from __future__ import annotations

import json
from statistics import median
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import (
    Cell,
    asked,
    cells_of,
    chunks,
    engine_note,
    groups_present,
    pieces_of,
    ratio_between,
    stages_present,
)
from s2a_bench.experiments.latency.view.frame_path import frame_table
from s2a_bench.stats import summary_of
from s2a_bench.trace import RESIDUAL_LIMIT
from s2a_bench.writers.tables import ABSENT, TextTable, interval, mean_sd, number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.stats import Ratio, Summary
    from s2a_bench.store.run import Run

TITLES = {
    "e2e_without_inference": "End to end without inference",
    "e2e_without_model": "End to end without model",
    "e2e": "End to end",
}
"""What is compared, and how it is called."""


_FOOT = {
    "residual": "residual",
    "e2e_without_inference": "e2e w/o infer.",
    "preprocess": "preproc.",
    "e2e_without_model": "e2e w/o model",
    "inference": "infer.",
    "e2e": "e2e",
}
"""What stands below the stages, each with its short name; what the engines of a run do not tell is left out."""


def stage_table(run: Run, *, full: bool = True) -> TextTable:
    """Lay out the stages in the order of the path, a column a cell: the median, and mean ± sd where ``full``.

    Inference stands below the residual, so that what is compared, e2e without inference, reads as one sum, and so do
    e2e without model and e2e below it.
    """
    cells = cells_of(run)
    rows: list[tuple[str, ...]] = []
    last = ""

    def add(group: str, name: str, values: list[Floats]) -> None:
        rows.append((group, name, *(_entry(summary_of(found), full) for found in values)))

    for stage in stages_present(cells):
        if (group := run.stages[stage]) != "inference":
            add("" if group == last else group, stage, [cell.values_ms(stage) for cell in cells])
            last = group
    below = len(rows)
    for metric in _foot(cells):
        add("", metric.replace("_", " "), [cell.values_ms(metric) for cell in cells])
    title = "Stages in ms: median (mean ± sd)" if full else "Stages in ms: medians"
    return TextTable(
        title,
        ("group", "stage", *(cell.name for cell in cells)),
        rows,
        2,
        frozenset({below + 1}),
        _notes(run, cells),
    )


def group_table(run: Run) -> TextTable:
    """Lay out the groups as columns and the cells as rows: for runs of many cells."""
    cells = cells_of(run)
    groups = [group for group in groups_present(cells) if group != "inference"]
    foot = _foot(cells)[1:]
    rows = []
    for cell in cells:
        values = [cell.group_ms(group) for group in groups]
        values += [cell.values_ms(metric) for metric in foot]
        rows.append((cell.name, *(_entry(summary_of(found), full=False) for found in values)))
    header = ("cell", *groups, *(_FOOT[metric] for metric in foot))
    return TextTable("Groups of stages in ms: medians", header, rows, 1, notes=_notes(run, cells))


def summary_table(run: Run, metric: str = "e2e_without_inference", *, brief: bool = False) -> TextTable:
    """Lay out what a publication quotes: n, spread, percentiles, and the ratios to what is compared with.

    A ``brief`` one leaves room for more ratios than two: of the spread it has p99.
    """
    cells = cells_of(run)
    bases = [
        base for base in cells if base.values_ms(metric).size and any(cell.is_compared_with(base) for cell in cells)
    ]
    rows = []
    found: list[Ratio] = []
    for cell in cells:
        summary = summary_of(cell.values_ms(metric))
        numbers = (
            [mean_sd(summary), number(summary.median), number(summary.p90), number(summary.p99)]
            if summary
            else [ABSENT] * 4
        )
        over = {base.name: _ratio(cell, base, metric, run.bootstrap_seed) for base in bases}
        found += [ratio for ratio in over.values() if ratio]
        ratios = ("1" if cell.name == base else interval(ratio) for base, ratio in over.items())
        shown = (numbers[1], numbers[3]) if brief else (str(cell.n), str(cell.errors), *numbers)
        rows.append((cell.name, *shown, *ratios))
    figures = ("median", "p99") if brief else ("n", "errors", "mean ± sd", "median", "p90", "p99")
    header = ("cell", *figures, *(f"ratio to {base.name}" for base in bases))
    title = f"{TITLES[metric]} in ms; ratios of medians [95 % interval]"
    return TextTable(title, header, rows, 1, notes=(*_notes(run, cells), *filter(None, [launches_note(found)])))


def token_table(run: Run) -> TextTable | None:
    """Lay out what happens to every token after it left the engine; None where no server tells when that was."""
    cells = [cell for cell in cells_of(run) if cell.token_delay_ms().size]
    if not cells:
        return None
    rows = []
    for cell in cells:
        delay, gap = summary_of(cell.token_delay_ms()), summary_of(cell.itl_ms())
        row = [number(value) for value in (delay.median, delay.p90, delay.p99)] if delay else [ABSENT] * 3
        row += [number(value) for value in (gap.median, gap.p99)] if gap else [ABSENT] * 2
        rows.append((cell.name, *row))
    header = ("cell", "delay median", "p90", "p99", "gap median", "gap p99")
    title = f"{pieces_of(run).capitalize()} in ms: engine to client (delay), and from one to the next (gap)"
    return TextTable(title, header, rows, 1, notes=_engine_notes(run, cells))


def fact_table(run: Run) -> TextTable | None:
    """Lay out what was told of the requests besides their marks; None where nothing was, or the folder is older."""
    cells = cells_of(run) if run.facts else []
    told = [[json.loads(str(facts)) for facts in cell.good["facts"]] for cell in cells]
    rows = []
    for fact, declared in run.facts.items():
        values = [[facts[fact] for facts in of_cell if fact in facts] for of_cell in told]
        if any(values):
            entries = (number(median(found)) if found else ABSENT for found in values)
            rows.append((fact, declared["unit"], *entries))
    header = ("fact", "unit", *(cell.name for cell in cells))
    return TextTable("Facts: medians", header, rows, 2, notes=_notes(run, cells)) if rows else None


def _foot(cells: list[Cell]) -> list[str]:
    """List what stands below the stages: preprocessing and e2e without model only where somebody tells them."""
    told = {"preprocess", "e2e_without_model"}
    return [name for name in _FOOT if name not in told or any(cell.values_ms(name).size for cell in cells)]


def _entry(summary: Summary | None, full: bool) -> str:
    """Write one entry of the stage table."""
    if summary is None:
        return ABSENT
    return f"{number(summary.median)} ({mean_sd(summary)})" if full else number(summary.median)


def _ratio(cell: Cell, base: Cell, metric: str, seed: int) -> Ratio | None:
    """Return the ratio of a cell to a base, where that is a comparison."""
    return ratio_between(cell, base, metric, seed) if cell.is_compared_with(base) else None


def launches_note(ratios: Iterable[Ratio]) -> str:
    """Return for what the intervals of ratios hold, one launch or any like those measured; empty without intervals."""
    told = [ratio for ratio in ratios if ratio.low is not None]
    if not told:
        return ""
    spreads = sorted(ratio.launch_sd for ratio in told if ratio.launch_sd is not None)
    if not spreads:
        return "The intervals hold for this launch only, the next may differ by more: measure with --launches 5."
    span = " to ".join(dict.fromkeys(f"{spread * 100:.2g}" for spread in (spreads[0], spreads[-1])))
    return (
        f"Ratios are over {max(ratio.launches for ratio in told)} launches, which differ by a standard deviation of "
        f"{span} %; the intervals (Student's t) hold for launches like these."
    )


def _notes(run: Run, cells: list[Cell]) -> tuple[str, ...]:
    """Return what a reader must know besides the numbers."""
    counts = sorted({cell.n for cell in cells})
    span = " to ".join(str(count) for count in dict.fromkeys((*counts[:1], *counts[-1:])))
    notes = [f"n = {span} samples a cell, warm-ups left out." if counts else "No samples."]
    if cells:
        payloads = dict.fromkeys(
            f"{cell.pipeline} {cell.about['payload']}" for cell in cells if cell.about["payload"] not in {"none", ""}
        )
        notes.append(f"{asked(run, cells)}; payload: {', '.join(payloads) or 'none'}.")
    if shape := chunks(run):
        notes.append(f"Each answer is a chunk of {shape} numbers, not tokens.")
    notes += _engine_notes(run, cells)
    if any(cell.has_ingest for cell in cells):
        notes.append(
            "A llama-server's ingest slices and resizes the picture, which our engine counts as inference: compare e2e "
            "or e2e without model. Of a llama-server that is e2e less the prompt_ms it reports, assumed to be all that "
            "its model computes before the first token that it sends."
        )
    if flagged := sum(cell.flagged() for cell in cells):
        notes.append(
            f"{flagged} of {sum(cell.n for cell in cells)} samples have a residual above {RESIDUAL_LIMIT:.0%}"
            " of e2e without inference."
        )
    if failed := sum(cell.errors for cell in cells):
        notes.append(f"{failed} samples failed and are in no number here; samples.csv says why.")
    return tuple(notes)


def _engine_notes(run: Run, cells: list[Cell]) -> tuple[str, ...]:
    """Return what did not really answer, as a sentence."""
    note = engine_note(run, cells)
    return (note.sentence(),) if note else ()


def latency_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a latency run by its file's name."""
    tables = {"stages": stage_table(run), "summary": summary_table(run), "summary-e2e": summary_table(run, "e2e")}
    if any(cell.values_ms("e2e_without_model").size for cell in cells_of(run)):
        tables["summary-model"] = summary_table(run, "e2e_without_model")
    if tokens := token_table(run):
        tables["tokens"] = tokens
    if frames := frame_table(run):
        tables["frames"] = frames
    if facts := fact_table(run):
        tables["facts"] = facts
    return tables
