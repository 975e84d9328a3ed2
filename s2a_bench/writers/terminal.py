"""Text tables laid out for a terminal of 100 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.text import one_line, visible
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from rich.console import RenderableType


_WIDTH = 100
"""Columns of the terminal that is planned for."""


def lay_out(table: TextTable) -> RenderableType:
    """Turn a table into one for the terminal: long headers broken, the gaps narrowed where that makes it fit."""
    from rich import box
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    header = [*table.header[: table.left], *(_broken(name) for name in table.header[table.left :])]
    lines = [[*name.split("\n"), *column] for name, column in zip(header, zip(*table.rows, strict=True), strict=False)]
    natural = sum(max(map(len, column)) for column in lines)
    gap = 1 if natural + 2 * (len(lines) - 1) <= _WIDTH else 0
    shown = Table(
        title=Text(one_line(table.title)),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, gap, 0, 0),
        pad_edge=False,
    )
    for place, name in enumerate(header):
        shown.add_column(Text(visible(name)), justify="left" if place < table.left else "right", no_wrap=True)
    for place, row in enumerate(table.rows):
        if place in table.rules:
            shown.add_section()
        shown.add_row(*(Text(one_line(text)) for text in row))
    return Padding(shown, (0, 0, 1, 0))


def _broken(name: str) -> str:
    """Break the header of a column of numbers."""
    if name.startswith("ratio to "):
        return name.replace("ratio to ", "ratio to\n").replace("?", "?\n")
    return name.replace("/", "/\n") if " " not in name else name.replace(" infer", "\ninfer")
