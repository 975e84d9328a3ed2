"""Rows as CSV, every digit kept."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


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
