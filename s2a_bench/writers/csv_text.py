"""The tables of a run as files: Markdown, LaTeX, and CSV with every digit and the provenance of each row."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

from s2a_bench.errors import StoreError
from s2a_bench.store.files import why
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.text import visible
from s2a_bench.writers.latex import to_latex
from s2a_bench.writers.tables import TextTable, to_markdown

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.provenance import Origins
    from s2a_bench.stats import Summary
    from s2a_bench.store.run import StoredRun

SUMMARY = ("n", "median", "mean", "sd", "p90", "p99")
"""The columns of a summary in every table."""
summary_values: Callable[[Summary], tuple[object, ...]] = attrgetter(*SUMMARY)


@dataclass(frozen=True, slots=True)
class CsvTable:
    """A table for CSV; None is an empty field."""

    header: tuple[str, ...]
    rows: list[tuple[object, ...]]

    @classmethod
    def of(cls, header: Iterable[str], rows: Iterable[Iterable[object]]) -> CsvTable:
        return cls(tuple(header), [tuple(row) for row in rows])

    @classmethod
    def of_frame(cls, rows: pd.DataFrame) -> CsvTable:
        whole = rows.astype(object).where(rows.notna(), None)
        return cls.of(map(str, rows.columns), whole.itertuples(index=False, name=None))

    def coded(self, origins: Origins, cells: Sequence[str] = ()) -> CsvTable:
        """Return the table with the provenance of each row as its last column: that of its cell, or of the run.

        The cells of the rows are ``cells``, else the column ``cell``.
        """
        if PROVENANCE in self.header:  # a table of the store
            return self
        if not cells and "cell" in self.header:
            cells = [str(row[self.header.index("cell")]) for row in self.rows]
        codes = map(origins.of_row, cells) if cells else [origins.code] * len(self.rows)
        rows = [(*row, code) for row, code in zip(self.rows, codes, strict=True)]
        return CsvTable((*self.header, PROVENANCE), rows)

    def text(self, origins: Origins) -> str:
        """Return the CSV of the `coded` table."""
        out = io.StringIO()
        table = self.coded(origins)
        rows = csv.writer(out, lineterminator="\n")
        for row in (table.header, *table.rows):
            rows.writerow(visible(each) if isinstance(each, str) else each for each in row)
        return out.getvalue()


def write_texts(run: StoredRun, tables: Mapping[str, TextTable], csvs: Mapping[str, CsvTable]) -> None:
    """Write each table to ``tables/`` as .md and .tex, and the CSV files; raises StoreError."""
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
