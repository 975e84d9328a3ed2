"""The tables of a run as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import StoreError
from s2a_bench.store.room import why
from s2a_bench.writers.tables import TextTable, to_latex, to_markdown

if TYPE_CHECKING:
    from s2a_bench.store.run import Run
    from s2a_bench.writers.csv_text import CsvTable


def write_texts(run: Run, tables: Mapping[str, TextTable], csvs: Mapping[str, CsvTable]) -> list[Path]:
    """Write ``tables/``: each table as .md and .tex, and those for programs under their names; raises StoreError."""
    texts = {f"{name}.md": to_markdown(table) for name, table in tables.items()}
    texts |= {f"{name}.tex": to_latex(table) for name, table in tables.items()}
    texts |= {name: table.text(run.origins) for name, table in csvs.items()}
    folder = run.path / "tables"
    try:
        folder.mkdir(exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {folder}: {why(error, folder)}; the samples are kept") from error
    return [folder / name for name in texts]
