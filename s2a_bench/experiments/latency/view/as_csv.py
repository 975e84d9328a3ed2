"""The tables of a run for programs: CSV in long form, one row a value, every digit kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import Cell, cells_of, ratios, stages_present
from s2a_bench.stats import summary_of
from s2a_bench.writers.csv_text import SUMMARY, CsvTable, summary_values

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

RATIOS = ("metric", "of", "to", "value", "ci95_low", "ci95_high", "launches", "launch_sd", "emulated")
"""The columns of a table of ratios."""

_METRICS = ("e2e_without_inference", "e2e_without_model", "e2e", "ttft", "frame_age")


def csv_texts(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table: stages.csv, summary.csv, ratios.csv; times in ms, what is absent has no row."""
    cells = cells_of(run)
    found = ratios(cells, run.bootstrap_seed)
    return {
        "stages.csv": CsvTable.of(("cell", "group", "stage", *SUMMARY, "emulated"), _stages(cells)),
        "summary.csv": CsvTable.of(("cell", "metric", "errors", "warmups", *SUMMARY, "emulated"), _summaries(cells)),
        "ratios.csv": CsvTable.of(
            RATIOS,
            (
                (f"{metric}_ms", of.name, to.name, *astuple(ratio), of.emulated or to.emulated)
                for metric, of, to, ratio in found
            ),
        ),
    }


def _stages(cells: list[Cell]) -> Iterator[tuple[object, ...]]:
    """Yield a row a cell and stage, the residual last."""
    for cell in cells:
        for stage in (*stages_present([cell]), "residual"):
            if summary := summary_of(cell.values_ms(stage)):
                yield cell.name, cell.stages.get(stage, ""), stage, *summary_values(summary), cell.emulated


def _summaries(cells: list[Cell]) -> Iterator[tuple[object, ...]]:
    """Yield a row a cell and metric; a cell in which everything failed has one row, without numbers."""
    for cell in cells:
        metrics = {f"{metric}_ms": cell.values_ms(metric) for metric in _METRICS}
        metrics |= {"itl_ms": cell.itl_ms(), "residual_share": cell.residual_shares()}
        found = {name: summary for name, values in metrics.items() if (summary := summary_of(values))}
        for name, summary in found.items():
            yield cell.name, name, cell.errors, cell.warmups, *summary_values(summary), cell.emulated
        if not found:
            yield cell.name, "", cell.errors, cell.warmups, 0, *[None] * (len(SUMMARY) - 1), cell.emulated
