"""Rows as CSV, every digit kept."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.stats import Summary

SUMMARY = ("n", "median", "mean", "sd", "p90", "p99")
"""The columns of a summary, in the order of every table."""


def summary_values(summary: Summary) -> tuple[object, ...]:
    """Return a summary's values in the order of `SUMMARY`."""
    return tuple(getattr(summary, name) for name in SUMMARY)


def csv_text(header: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> str:
    """Write rows as CSV; None is an empty field."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def frame_csv(rows: pd.DataFrame) -> str:
    """Write a table's rows as CSV; what is missing is an empty field."""
    whole = rows.astype(object).where(rows.notna(), None)
    return csv_text(tuple(map(str, rows.columns)), whole.itertuples(index=False, name=None))
