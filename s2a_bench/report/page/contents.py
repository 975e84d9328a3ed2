"""What the page shows of each command's runs: the tables and figures that the command itself makes, and sentences."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from s2a_bench.experiments import experiment_of
from s2a_bench.report.page import Content
from s2a_bench.writers.tables import Note

if TYPE_CHECKING:
    from s2a_bench.store.run import Run
    from s2a_bench.writers.tables import TextTable


def content_of(run: Run, *, against_paper: bool) -> Content:
    """Return what a run shows; of a run without rows nothing, of an unknown command the names of its tables."""
    if not run.row_counts():
        return Content(summary=("The run has no rows: it ended before anything was measured.",))
    if (experiment := experiment_of(str(run.manifest["command"]))) is not None:
        shown = experiment.show(run, against="paper" if against_paper else "")
        return Content(shown.sentences, shown.tables, shown.main, shown.csvs, shown.figures, shown.lanes)
    return _other(run)


def _other(run: Run) -> Content:
    """Return what lies in a run that has no view of its own."""
    rows = [f"{name} ({count} rows)" for name, count in run.row_counts().items()]
    return Content(summary=(f"There is no view of {run.manifest['command']} runs; this one holds {', '.join(rows)}.",))


def labels_of(tables: Iterable[TextTable]) -> list[str]:
    """Return the labels that a run carries, since the notes of its tables do."""
    notes = [note for table in tables for note in table.notes if isinstance(note, Note)]
    return list(dict.fromkeys(label for note in notes for label in note.labels))
