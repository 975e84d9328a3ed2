"""What commands print: one JSON object, or tables and lines on a console."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.secrets import struck
from s2a_bench.text import one_line, visible
from s2a_bench.writers.tables import TextTable, lay_out

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 100
"""Columns of a table if the output is not a terminal and COLUMNS is not set."""

Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output")]


def shown(line: str) -> str:
    """Return a text as one printable line: every character visible, no secret."""
    return one_line(struck(line))


def print_json(whole: dict[str, Any]) -> None:
    text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(visible(text) + "\n")  # invisible characters occur in strings only, and are escaped as in JSON


def console() -> Console:
    """Return a console of the terminal's width, else of COLUMNS, else of `WIDTH`."""
    from rich.console import Console

    terminal = Console()
    return terminal if terminal.is_terminal or os.environ.get("COLUMNS", "").isdigit() else Console(width=WIDTH)


def print_table(table: TextTable) -> None:
    to = console()
    to.print(lay_out(table, to.width))


def print_line(line: str, to: Console | None = None) -> None:
    """Print one line without wrapping it, on a console or else on standard output."""
    (to or console()).print(shown(line), markup=False, highlight=False, soft_wrap=True)


def print_error(line: str) -> None:
    print(shown(line), file=sys.stderr)  # noqa: T201 - the command line's own output


def print_failures(*runs: tuple[Path, Sequence[str]]) -> None:
    """Print what of these run folders could not be built; the exit code is 1 if there is anything."""
    for folder, failures in runs:
        for failure in failures:
            print_error(f"error: {failure}; all else is written; once it is fixed, s2a-bench report {folder} shows it")
    if any(failures for _, failures in runs):
        raise typer.Exit(1)
