"""Sweeps: a file names a command and axes, every cell of the grid runs once, and finished cells are kept.

A cell is one command line of this program: the command's own parser reads the settings, its own run folder holds the
data. `CellWorkers` is the seam that runs cells: on this machine, or on Ray.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, Protocol, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.options import Names, Options, option
from s2a_bench.store.run import read_run
from s2a_bench.sweep.file import find_sweep, sweep_files

Flag: TypeAlias = Literal["value", "hidden", "switch", "toggle", "argument"]
"""A switch is given or not; a toggle has an opposite, as --flag and --no-flag; no hint names a hidden flag."""


@dataclass(frozen=True, slots=True)
class SweepCommand:
    name: str
    flags: Mapping[str, Flag]
    check: Callable[[Sequence[str]], bool]
    """Parses arguments without running them; raises UsageError. Returns True for a virtual cell: it is computed, so
    that many may run at once, anywhere. Returns False for one that measures."""


@dataclass(frozen=True, slots=True)
class SweepCell:
    number: int
    repeat: int
    settings: dict[str, Any]
    argv: tuple[str, ...]
    virtual: bool
    board: str
    """The machine that it needs, empty for any."""
    config_hash: str

    @property
    def name(self) -> str:
        return f"{self.number:04d}"

    @property
    def key(self) -> tuple[str, int]:
        return self.name, self.repeat

    @property
    def label(self) -> str:
        return f"{self.name}-r{self.repeat}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a cell; an empty error means success."""

    error: str
    wall_s: float
    started: str
    machine: dict[str, Any]


class CellWorkers(AbstractContextManager["CellWorkers"], Protocol):
    """Runs cells, as a context manager; leaving it early ends the running ones."""

    width: int

    def submit(self, cell: SweepCell, folder: Path) -> Future[Any]:
        """Start or queue a cell; ``folder`` must not exist yet."""

    def collect(self, future: Future[Any], folder: Path) -> Outcome:
        """Return the outcome of a finished future; the run folder of its cell is then below ``folder``."""


COPY: Final = "sweep.toml"


class SweepConfig(Options):
    file: str = option(
        "",
        f"sweep file (TOML), or the name of one: {', '.join(sweep_files())}; not needed with --resume",
        argument=True,
        names=sweep_files,
    )
    resume: Path | None = option(None, "folder of an interrupted sweep: run the cells that it has not run yet")
    retry_failed: bool = option(False, "with --resume: run the cells that failed once more")
    dry_run: bool = option(False, "print the cells, and run nothing")
    trust_file: bool = option(
        False, "allow a file to name programs, URLs off this machine, or keys for a URL: only one that you have read"
    )
    board: Names = option((), "name of this machine in the file's 'board' axis; several with commas")
    ray: str = option("", "run on a Ray cluster: its ADDRESS, auto, or local (a cluster of this machine)")
    jobs: int = option(0, "virtual cells at once on this machine; 0: one a core", ge=0)
    output: Path = option(Path("results"), "folder for the sweep's folder")

    def check(self) -> None:
        if self.retry_failed and self.resume is None:
            raise UsageError("`retry_failed`: name the sweep's folder with `resume`")
        if self.board and self.ray:
            raise UsageError("`board` and `ray` exclude each other: on Ray every node offers its own boards")
        if not self.file and self.resume is None:
            raise UsageError("name a sweep file, or the folder of a sweep with `resume`")

    @property
    def source(self) -> Path:
        """Return the path of the sweep file; raises UsageError for an unknown name."""
        return self.resume / COPY if self.resume and not self.file else find_sweep(self.file)

    @cached_property
    def boards(self) -> tuple[str, ...] | None:
        """Return the names of this machine, of now or of the sweep's start; None on Ray. Raises StoreError."""
        if self.ray or self.board or self.resume is None:
            return None if self.ray else self.board
        return tuple(read_run(self.resume).manifest["configuration"].get("boards") or ())

    @property
    def width(self) -> int:
        return self.jobs or len(os.sched_getaffinity(0))
