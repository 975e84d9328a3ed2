"""The tables of a run as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import StoreError
from s2a_bench.report.frame_path import frame_table
from s2a_bench.report.full import csv_texts
from s2a_bench.report.tables import TextTable, stage_table, summary_table, to_latex, to_markdown, token_table

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


def write_texts(run: Run, tables: Mapping[str, TextTable], csvs: Mapping[str, str]) -> list[Path]:
    """Write ``tables/``: each table as .md and .tex, and CSV texts under their names; raises StoreError."""
    texts = {f"{name}.md": to_markdown(table) for name, table in tables.items()}
    texts |= {f"{name}.tex": to_latex(table) for name, table in tables.items()}
    texts |= csvs
    folder = run.path / "tables"
    try:
        folder.mkdir(exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {folder}: {error.strerror}; the samples are kept") from error
    return [folder / name for name in texts]
