"""The last minute of a watch on a terminal, in the table that its run will have."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

import pandas as pd
from rich.console import Group
from rich.text import Text

from s2a_bench.clock import now_ns
from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.watch.rows import ExchangeRow
from s2a_bench.plugins.watch.view import cycle_table
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.text import one_line
from s2a_bench.writers.tables import lay_out

if TYPE_CHECKING:
    from rich.console import RenderableType

LAST_NS: Final = 60 * 10**9
MOST: Final = 2_000
"""Exchanges that are looked at, once in `AGAIN_NS`."""
AGAIN_NS: Final = 10**9


@dataclass(slots=True)
class LastMinute:
    rows: deque[ExchangeRow] = field(default_factory=lambda: deque(maxlen=MOST))
    sends: dict[str, str] = field(default_factory=dict)
    """Kind of exchange -> what its requests hold."""
    _last: RenderableType = "nothing has passed in the last minute"
    _drawn_ns: int = 0

    def draw(self, width: int) -> RenderableType:
        if now_ns() - self._drawn_ns > AGAIN_NS:
            self._drawn_ns = now_ns()
            rows = [asdict(row) for row in list(self.rows) if row.request_ns > self._drawn_ns - LAST_NS]
            if rows:
                cells = Cells(pd.DataFrame(rows), ExchangeRow, Origins(Provenance())).split()
                sends = (Text(one_line(f"{cell} sends {each}")) for cell, each in list(self.sends.items()))
                self._last = Group(lay_out(cycle_table(cells), width), *sends)
        return self._last

    def lines(self) -> Iterator[str]:
        return iter(())  # the run's own table follows
