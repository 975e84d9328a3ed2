"""The view of an experiment that has a metric table and no shape of its own: a table, CSV and JSON from the metrics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from s2a_bench.experiments import Compared, Metric, Shown, Subject, View
from s2a_bench.stats import Summary, summary_of
from s2a_bench.writers.as_json import frame, summaries
from s2a_bench.writers.csv_text import SUMMARY, CsvTable, summary_values
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.store.run import Run


def plain_view(compared: Compared) -> View:
    """Return a view that shows the metrics of ``compared``, a row a cell."""

    def show(run: Run, **_: Any) -> Shown:
        cells = compared.subjects(run)
        notes = tuple(compared.origin(run))
        table = _table(run, compared, cells, notes)
        rows = (
            (cell.name, metric.name, metric.unit, *summary_values(found))
            for cell, metric, found in _found(compared, cells)
        )
        return Shown(
            sentences=list(_sentences(compared, cells)),
            tables={"metrics": table},
            main=["metrics"],
            notes=notes,
            csvs={"metrics.csv": CsvTable.of(("cell", "metric", "unit", *SUMMARY), rows)},
            json=lambda: frame(run, [_json(compared, cell) for cell in cells], []),
        )

    return show


def values_of(cell: Subject, metric: Metric) -> NDArray[np.float64]:
    """Return a metric's values in one array."""
    rows = cell.rows(metric.name)
    return np.concatenate(rows) if rows else np.empty(0)


def _found(compared: Compared, cells: list[Subject]) -> Iterator[tuple[Subject, Metric, Summary]]:
    """Yield every cell and metric with a summary of its values, where it has any."""
    for cell in cells:
        for metric in compared.metrics.values():
            if found := summary_of(values_of(cell, metric)):
                yield cell, metric, found


def _table(run: Run, compared: Compared, cells: list[Subject], notes: tuple[str, ...]) -> TextTable:
    found = {(cell.name, metric.name): summary for cell, metric, summary in _found(compared, cells)}
    header = ("cell", "n", "errors", *(_head(metric) for metric in compared.metrics.values()))
    rows = []
    for cell in cells:
        values = [
            number(getattr(summary, metric.statistic)) if (summary := found.get((cell.name, metric.name))) else ABSENT
            for metric in compared.metrics.values()
        ]
        rows.append((cell.name, str(cell.n), str(cell.errors), *values))
    return TextTable(str(run.manifest["command"]), header, rows, 1, notes=notes)


def _head(metric: Metric) -> str:
    unit = f" ({metric.unit})" if metric.unit else ""
    return f"{metric.title or metric.name}{unit}, {metric.statistic}"


def _sentences(compared: Compared, cells: list[Subject]) -> Iterator[str]:
    """Yield a sentence for every metric that is compared by default."""
    for cell, metric, found in _found(compared, cells):
        if metric.name in compared.shown:
            value = number(getattr(found, metric.statistic))
            unit = f" {metric.unit}" if metric.unit else ""
            yield f"{cell.name}: {metric.title or metric.name} {value}{unit} ({metric.statistic} of {found.n})."


def _json(compared: Compared, cell: Subject) -> dict[str, Any]:
    numbers = summaries((metric.name, values_of(cell, metric)) for metric in compared.metrics.values())
    return {"cell": cell.name, **cell.setting, "n": cell.n, "errors": cell.errors, **numbers}
