"""Sweeps on the terminal: what would run, and how it went."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import shown
from s2a_bench.text import visible

if TYPE_CHECKING:
    from s2a_bench.store.sweep import Sweep
    from s2a_bench.sweep import Cell
    from s2a_bench.sweep.plan import Plan
    from s2a_bench.sweep.timing import Expected

MINUTE_S, HOUR_S = 60, 3600


def print_plan(plan: Plan, cells: Sequence[Cell], expected: Expected) -> None:
    """Print every cell as the command that it is, and the time to expect."""
    console = open_console()
    for cell in cells:
        where = f"  on {cell.board}" if cell.board else ""
        console.print(
            visible(f"{cell.name}-r{cell.repeat}  s2a-bench {shlex.join(cell.argv)}{where}"),
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
    virtual = sum(cell.virtual for cell in cells)
    counts = f"{len(cells)} of {len(plan.cells)} cells to run, {virtual} virtual and {len(cells) - virtual} measured"
    rests = f", {plan.rest_s:g} s of rest after each measured one" if plan.rest_s and virtual < len(cells) else ""
    time = "not known" if expected.seconds is None else f"about {duration(expected.seconds)}"
    console.print(f"{counts}{rests}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"time to expect: {time}: {expected.source}", markup=False, highlight=False, soft_wrap=True)


def print_sweep(sweep: Sweep) -> None:
    """Print the failed cells, and a line for all."""
    console = open_console()
    cells = sweep.cells
    failed = cells[cells["state"] == "failed"]
    if len(failed):
        table = Table(title="Cells that failed", title_justify="left")
        for name in ("cell", "setting", "error"):
            table.add_column(name, overflow="fold")
        for row in failed.to_dict("records"):
            setting = " ".join(f"{key}={value}" for key, value in json.loads(row["settings"]).items())
            texts = (f"{row['cell']}-r{row['repeat']}", setting, row["error"])
            table.add_row(*(Text(shown(text)) for text in texts))
        console.print(table)
    hosts = ", ".join(sorted(set(cells["host"])))
    console.print(
        f"{len(cells) - len(failed)} of {len(cells)} cells finished on {hosts}", markup=False, highlight=False
    )
    console.print(f"sweep folder: {sweep.path}", markup=False, highlight=False, soft_wrap=True)


def duration(seconds: float) -> str:
    """Write a time for people."""
    if seconds < MINUTE_S:
        return f"{max(seconds, 1):.0f} s"
    if seconds < HOUR_S:
        return f"{seconds / MINUTE_S:.0f} min"
    return f"{seconds / HOUR_S:.1f} h"
