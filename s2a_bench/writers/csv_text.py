"""Rows as CSV, every digit kept, each with the provenance of its numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.store.schema import PROVENANCE
from s2a_bench.text import visible

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.provenance import Origins
    from s2a_bench.stats import Summary

SUMMARY = ("n", "median", "mean", "sd", "p90", "p99")
"""The columns of a summary, in the order of every table."""


def summary_values(summary: Summary) -> tuple[object, ...]:
    """Return a summary's values in the order of `SUMMARY`."""
    return tuple(getattr(summary, name) for name in SUMMARY)


@dataclass(frozen=True, slots=True)
class CsvTable:
    """A table for programs; None is an empty field."""

    header: tuple[str, ...]
    rows: list[tuple[object, ...]]

    @classmethod
    def of(cls, header: Iterable[str], rows: Iterable[Iterable[object]]) -> CsvTable:
        """Keep a table's rows."""
        return cls(tuple(header), [tuple(row) for row in rows])

    @classmethod
    def of_frame(cls, rows: pd.DataFrame) -> CsvTable:
        """Keep the rows of a DataFrame; what is missing is an empty field."""
        whole = rows.astype(object).where(rows.notna(), None)
        return cls.of(map(str, rows.columns), whole.itertuples(index=False, name=None))

    def text(self, origins: Origins) -> str:
        """Write it; the last column says where a row's numbers come from: those of its ``cell``, or of the run."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        told = PROVENANCE in self.header  # a table of the store has it already
        cell = self.header.index("cell") if "cell" in self.header else None
        writer.writerow(map(_inert, self.header if told else (*self.header, PROVENANCE)))
        for row in self.rows:
            code = origins.code if cell is None else origins.of_row(str(row[cell]))
            writer.writerow(map(_inert, row if told else (*row, code)))
        return out.getvalue()


def _inert(value: object) -> object:
    """Return a value of visible letters that no spreadsheet takes for a formula (OWASP, CSV injection)."""
    if not isinstance(value, str):
        return value
    value = visible(value)
    if not value.startswith(("=", "+", "-", "@", "\t", "\n")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
