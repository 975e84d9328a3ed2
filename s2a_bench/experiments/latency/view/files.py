"""The tables of a latency run as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.as_csv import csv_texts
from s2a_bench.experiments.latency.view.frame_path import frame_table
from s2a_bench.experiments.latency.view.tables import stage_table, summary_table, token_table
from s2a_bench.writers.files import write_texts
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def latency_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a latency run by its file's name."""
    tables = {"stages": stage_table(run), "summary": summary_table(run), "summary-e2e": summary_table(run, "e2e")}
    if tokens := token_table(run):
        tables["tokens"] = tokens
    if frames := frame_table(run):
        tables["frames"] = frames
    return tables


def write_tables(run: Run) -> list[Path]:
    """Write ``tables/``: the text tables as .md and .tex, and stages, summary and ratios in full as .csv."""
    return write_texts(run, latency_tables(run), csv_texts(run))
