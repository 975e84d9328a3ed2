"""Sweeps on the terminal and as JSON: what would run, and how it went."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table

from s2a_bench.cli.output import console as open_console

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
            f"{cell.name}-r{cell.repeat}  s2a-bench {shlex.join(cell.argv)}{where}",
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
            table.add_row(f"{row['cell']}-r{row['repeat']}", setting, row["error"])
        console.print(table)
    hosts = ", ".join(sorted(set(cells["host"])))
    console.print(
        f"{len(cells) - len(failed)} of {len(cells)} cells finished on {hosts}", markup=False, highlight=False
    )
    console.print(f"sweep folder: {sweep.path}", markup=False, highlight=False, soft_wrap=True)


def plan_json(cells: Sequence[Cell], expected: Expected, environment: dict[str, Any]) -> dict[str, Any]:
    """Return what would run as the ``--json`` object."""
    time = {"source": expected.source}
    return {
        "schema": "s2a-bench/1",
        "command": "sweep",
        "environment": environment,
        "expected": time if expected.seconds is None else {"s": expected.seconds, **time},
        "cells": [
            {
                "cell": cell.name,
                "repeat": cell.repeat,
                "state": "planned",
                "virtual": cell.virtual,
                "board": cell.board or None,
                "settings": cell.settings,
                "argv": list(cell.argv),
                "config_hash": cell.config_hash,
            }
            for cell in cells
        ],
        "ratios": [],
        "warnings": [],
    }


def sweep_json(sweep: Sweep) -> dict[str, Any]:
    """Return how a sweep went as the ``--json`` object."""
    return {
        "schema": "s2a-bench/1",
        "command": "sweep",
        "run": str(sweep.path),
        "state": sweep.manifest["state"],
        "environment": sweep.manifest["environment"],
        "cells": [
            {
                "cell": row["cell"],
                "repeat": int(row["repeat"]),
                "attempt": int(row["attempt"]),
                "state": row["state"],
                "error": row["error"] or None,
                "virtual": bool(row["virtual"]),
                "board": row["board"] or None,
                "host": row["host"],
                "settings": json.loads(row["settings"]),
                "argv": json.loads(row["argv"]),
                "config_hash": row["config_hash"],
                "run": str(sweep.path / row["folder"]) if row["folder"] else None,
                "started": row["started"],
                "wall_s": float(row["wall_s"]),
            }
            for row in sweep.cells.to_dict("records")
        ],
        "ratios": [],
        "warnings": [],
    }


def duration(seconds: float) -> str:
    """Write a time for people."""
    if seconds < MINUTE_S:
        return f"{max(seconds, 1):.0f} s"
    if seconds < HOUR_S:
        return f"{seconds / MINUTE_S:.0f} min"
    return f"{seconds / HOUR_S:.1f} h"
