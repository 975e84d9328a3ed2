"""How commands end on the terminal: one JSON object, or a console of a fixed width where there is no terminal."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 100
"""Columns of the tables where the output is no terminal."""

Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output")]


def print_json(whole: dict[str, Any]) -> None:
    """Print one strict JSON object on standard output."""
    json.dump(whole, sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write("\n")


def console() -> Console:
    """Return the console for tables: the terminal's, or one of `WIDTH` columns."""
    from rich.console import Console

    terminal = Console()
    return terminal if terminal.is_terminal else Console(width=WIDTH)
