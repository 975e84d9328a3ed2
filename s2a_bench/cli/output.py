"""How commands end on the terminal: one JSON object, or a console of a fixed width where there is no terminal."""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.secrets import struck
from s2a_bench.text import one_line, visible
from s2a_bench.writers.tables import TextTable, lay_out

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 100
"""Columns of the tables where the output is no terminal and COLUMNS does not say."""

Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output")]


def shown(line: str) -> str:
    """Return one line as it may be printed: all letters visible, no secret."""
    return one_line(struck(line))


def print_json(whole: dict[str, Any]) -> None:
    """Print one strict JSON object on standard output."""
    text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(visible(text) + "\n")  # hidden letters are in strings only, and escaped as JSON does


def console() -> Console:
    """Return the console for tables: the terminal's, or one of COLUMNS, else `WIDTH`."""
    from rich.console import Console

    terminal = Console()
    return terminal if terminal.is_terminal or os.environ.get("COLUMNS", "").isdigit() else Console(width=WIDTH)


def print_table(table: TextTable) -> None:
    """Print a table at the width of the console."""
    to = console()
    to.print(lay_out(table, to.width))


def print_line(line: str, to: Console | None = None) -> None:
    """Print one line as it is, however long, on a console; without one, on standard output."""
    (to or console()).print(shown(line), markup=False, highlight=False, soft_wrap=True)
