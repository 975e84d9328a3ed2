"""Sweeps: a file names a command and axes, every cell of the grid runs once, and what has run survives.

A cell is one command line of ours, so that nothing about a command is written down twice: its own parser reads the
settings, its own run folder holds the data. `Workers` is the seam where cells run: on this machine, or on Ray.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

Flag: TypeAlias = Literal["value", "switch", "toggle", "argument"]
"""A switch is given or not; a toggle has its opposite too, as --animation and --no-animation."""


@dataclass(frozen=True, slots=True)
class Command:
    """What a sweep must know of the command that it repeats."""

    name: str
    flags: Mapping[str, Flag]
    """What can be set, without the dashes."""
    check: Callable[[Sequence[str]], bool]
    """Parse arguments as the command line does, and run nothing; raises UsageError. Return True for a cell that is
    virtual: computed, so that many may run at once, anywhere; False for one that measures."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One setting, one time."""

    number: int
    repeat: int
    settings: dict[str, Any]
    argv: tuple[str, ...]
    """The command and its flags, but for the output folder."""
    virtual: bool
    board: str
    """The machine that it needs; empty: any."""
    config_hash: str

    @property
    def name(self) -> str:
        """Name the setting."""
        return f"{self.number:04d}"

    @property
    def key(self) -> tuple[str, int]:
        """Tell it from every other cell of its sweep."""
        return self.name, self.repeat


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a cell went; an empty error means well."""

    error: str
    wall_s: float
    started: str
    machine: dict[str, Any]
    """The environment that its run folder names."""


class Workers(Protocol):
    """Where cells run. Use as a context manager; leaving it early ends what is under way."""

    @property
    def width(self) -> int:
        """Return how many virtual cells run at once."""
        ...

    def submit(self, cell: Cell, folder: Path) -> Future[Any]:
        """Start a cell, or queue it; ``folder`` does not exist yet."""
        ...

    def collect(self, future: Future[Any], folder: Path) -> Outcome:
        """Return how a cell went whose future is done; its run folder then is below ``folder``."""
        ...

    def __enter__(self) -> Workers: ...  # noqa: PYI034 - Self is typing's since 3.11

    def __exit__(self, *_: object) -> None: ...


WORKERS: dict[str, str] = {
    "here": "s2a_bench.sweep.here:Here",
    "ray": "s2a_bench.sweep.on_ray:OnRay",
}
"""Name -> what runs cells."""
