"""The tables of a run laid out for a terminal of 100 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.report.cells import cells_of
from s2a_bench.report.frame_path import frame_table
from s2a_bench.report.tables import TextTable, group_table, stage_table, summary_table, token_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from s2a_bench.store.run import Run

_FULL_CELLS = 2
"""As many cells leave room for mean ± sd beside the medians."""
_WIDTH = 100
"""Columns of the terminal that is planned for."""
_STAGE_CELLS = 5
"""With more cells than these the cells become rows."""


def renderables(run: Run) -> list[RenderableType]:
    """Return what a latency run prints: the stages, then what is compared; end to end too where a model answers."""
    cells = cells_of(run)
    stages = group_table(run) if len(cells) > _STAGE_CELLS else stage_table(run, full=len(cells) <= _FULL_CELLS)
    shown = [stages]
    if any(cell.values_ms("e2e_without_inference").size for cell in cells):
        shown.append(summary_table(run))
    if any(cell.about["engine"] != "echo" or not cell.values_ms("e2e_without_inference").size for cell in cells):
        shown.append(summary_table(run, "e2e"))
    if tokens := token_table(run):
        shown.append(tokens)
    if frames := frame_table(run):
        shown.append(frames)
    return [*(lay_out(table) for table in shown), " ".join(stages.notes)]


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
        title=table.title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, gap, 0, 0),
        pad_edge=False,
    )
    for place, name in enumerate(header):
        shown.add_column(Text(name), justify="left" if place < table.left else "right", no_wrap=True)
    for place, row in enumerate(table.rows):
        if place in table.rules:
            shown.add_section()
        shown.add_row(*(Text(text) for text in row))
    return Padding(shown, (0, 0, 1, 0))


def _broken(name: str) -> str:
    """Break the header of a column of numbers."""
    if name.startswith("ratio to "):
        return name.replace("ratio to ", "ratio to\n")
    return name.replace("/", "/\n") if " " not in name else name.replace(" infer", "\ninfer")
