"""The last minute of a watch on a terminal: how often, how long, and what the robot sends."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from s2a_bench.clock import now_ns
from s2a_bench.experiments.cells import metrics_of
from s2a_bench.plugins.watch.rows import ExchangeRow
from s2a_bench.stats import summary_of
from s2a_bench.text import one_line
from s2a_bench.writers.tables import ABSENT, number

if TYPE_CHECKING:
    from rich.console import RenderableType

LAST_S: Final = 60
MOST: Final = 20_000
"""Exchanges that are looked at."""
COLUMNS: Final = ("period_s", "upload_s", "server_s", "inference_s", "download_s", "think_s")


@dataclass(slots=True)
class LastMinute:
    rows: deque[ExchangeRow] = field(default_factory=lambda: deque(maxlen=MOST))
    sends: dict[str, str] = field(default_factory=dict)
    """Cell -> what its requests hold."""

    def draw(self, width: int) -> RenderableType:  # noqa: ARG002 - rich fits tables itself
        since_ns = now_ns() - LAST_S * 10**9
        by_cell: dict[str, list[ExchangeRow]] = {}
        for row in list(self.rows):
            if row.asked_ns > since_ns:
                by_cell.setdefault(row.cell, []).append(row)
        table = Table("last minute", "n", "failed", "Hz", *(_titles()), "p99 age", box=None, header_style="bold")
        for cell, rows in by_cell.items():
            table.add_row(one_line(cell), *_entries(rows))
        return Group(table, *(Text(f"{one_line(cell)} sends {each}") for cell, each in list(self.sends.items())))

    def lines(self) -> Iterator[str]:
        return iter(())  # the run's own table follows


def _titles() -> list[str]:
    return [metrics_of(ExchangeRow)[name].title for name in COLUMNS]


def _entries(rows: Sequence[ExchangeRow]) -> Iterator[str]:
    """Yield how many, how many failed, how often, medians of times in ms, and the 99th percentile of the age."""
    metrics = metrics_of(ExchangeRow)
    spent_s = (rows[-1].asked_ns - rows[0].asked_ns) / 1e9
    yield str(len(rows))
    yield str(sum(bool(row.error) for row in rows))
    yield f"{(len(rows) - 1) / spent_s:.1f}" if spent_s > 0 else ABSENT
    for name in (*COLUMNS, "age_s"):
        summary = summary_of(np.array([value for row in rows if (value := metrics[name].read(row)) is not None]))
        which = "p99" if name == "age_s" else "median"
        yield ABSENT if summary is None else f"{number(getattr(summary, which) * 1e3)} ms"
