"""What the page shows of each command's runs: the tables and figures that the command itself makes, and sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments import experiment_of
from s2a_bench.report.page import Content
from s2a_bench.report.page.sentences import (
    latency_sentences,
    throughput_sentences,
)
from s2a_bench.writers.tables import Note

if TYPE_CHECKING:
    from s2a_bench.store.run import Run
    from s2a_bench.writers.tables import TextTable


def content_of(run: Run, *, against_paper: bool) -> Content:
    """Return what a run shows; of a run without rows nothing, of an unknown command the names of its tables."""
    if not run.row_counts():
        return Content(summary=("The run has no rows: it ended before anything was measured.",))
    command = str(run.manifest["command"])
    if (experiment := experiment_of(command)) is not None:
        shown = experiment.show(run, against="paper" if against_paper else "")
        return Content(shown.sentences, shown.tables, shown.main, shown.csvs, shown.figures, shown.lanes)
    return CONTENTS.get(command, _other)(run, against_paper)


def _latency(run: Run, against_paper: bool) -> Content:
    from s2a_bench.experiments.latency.view.as_csv import csv_texts
    from s2a_bench.experiments.latency.view.figures import latency_figures
    from s2a_bench.experiments.latency.view.files import latency_tables

    tables = latency_tables(run)
    main = [name for name in ("summary", "stages") if name in tables]
    figures = latency_figures(run, against_paper)
    return Content(latency_sentences(run), tables, main, csv_texts(run), figures)


def _throughput(run: Run, against_paper: bool) -> Content:
    from s2a_bench.experiments.throughput.view.figures import throughput_figures
    from s2a_bench.experiments.throughput.view.tables import throughput_csv, throughput_tables

    figures = throughput_figures(run, against_paper=against_paper)
    return Content(throughput_sentences(run), throughput_tables(run), ["throughput"], throughput_csv(run), figures)


def _other(run: Run, _against_paper: bool) -> Content:
    """Tell what lies in a run that has no view of its own."""
    rows = [f"{name} ({count} rows)" for name, count in run.row_counts().items()]
    return Content(summary=(f"There is no view of {run.manifest['command']} runs; this one holds {', '.join(rows)}.",))


CONTENTS: Final[dict[str, Callable[[Run, bool], Content]]] = {
    "latency": _latency,
    "throughput": _throughput,
}
"""Command -> what its run shows."""


def labels_of(tables: Iterable[TextTable]) -> list[str]:
    """Return the labels that a run carries, since the notes of its tables do."""
    notes = [note for table in tables for note in table.notes if isinstance(note, Note)]
    return list(dict.fromkeys(label for note in notes for label in note.labels))
