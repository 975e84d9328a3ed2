"""Sweeps: a file names a command and axes, every cell of the grid runs once, and what has run survives.

A cell is one command line of ours, so that nothing about a command is written down twice: its own parser reads the
settings, its own run folder holds the data. `CellWorkers` is the seam where cells run: on this machine, or on Ray.
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
"""A switch is given or not; a toggle has its opposite too, as --animation and --no-animation; no hint names what is
hidden."""


@dataclass(frozen=True, slots=True)
class SweepCommand:
    """What a sweep must know of the command that it repeats."""

    name: str
    flags: Mapping[str, Flag]
    """What can be set, without the dashes."""
    check: Callable[[Sequence[str]], bool]
    """Parse arguments as the command line does, and run nothing; raises UsageError. Return True for a cell that is
    virtual: computed, so that many may run at once, anywhere; False for one that measures."""


@dataclass(frozen=True, slots=True)
class SweepCell:
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
        return f"{self.number:04d}"

    @property
    def key(self) -> tuple[str, int]:
        return self.name, self.repeat

    @property
    def label(self) -> str:
        return f"{self.name}-r{self.repeat}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a cell went; an empty error means well."""

    error: str
    wall_s: float
    started: str
    machine: dict[str, Any]
    """The environment that its run folder names."""


class CellWorkers(AbstractContextManager["CellWorkers"], Protocol):
    """Where cells run. Use as a context manager; leaving it early ends what is under way."""

    width: int
    """How many virtual cells run at once."""

    def submit(self, cell: SweepCell, folder: Path) -> Future[Any]:
        """Start a cell, or queue it; ``folder`` does not exist yet."""
        ...

    def collect(self, future: Future[Any], folder: Path) -> Outcome:
        """Return how a cell went whose future is done; its run folder then is below ``folder``."""
        ...


WORKERS: dict[str, str] = {
    "local": "s2a_bench.sweep.perform:LocalWorkers",
    "ray": "s2a_bench.sweep.on_ray:RayWorkers",
}
"""Name -> what runs cells."""


COPY: Final = "sweep.toml"
"""The sweep file as it was, in the sweep's folder."""


class SweepConfig(Options):
    """A sweep to start, or one to go on with."""

    file: str = option(
        "",
        "sweep file (TOML), or the name of one: paper, quick, transports; not needed with --resume",
        argument=True,
        names=sweep_files,
    )
    resume: Path | None = option(None, "folder of a sweep that was interrupted: run what it has not run yet")
    retry_failed: bool = option(False, "with --resume: run the cells that failed once more")
    dry_run: bool = option(False, "print the cells and how long they will take, and run nothing")
    trust_file: bool = option(
        False, "run a file that names programs, URLs off this machine, or keys for a URL: only one that you have read"
    )
    board: Names = option((), "what this machine is in the file's 'board' axis; several with commas")
    ray: str = option("", "run on a Ray cluster: its ADDRESS, auto, or local (a cluster of this machine)")
    jobs: int = option(0, "virtual cells at once on this machine; 0: one a core", ge=0)
    output: Path = option(Path("results"), "folder for the sweep's folder")

    def check(self) -> None:
        """Refuse what makes no sense together; raises UsageError naming the fields."""
        if self.retry_failed and self.resume is None:
            raise UsageError("`retry_failed`: name the sweep's folder with `resume`")
        if self.board and self.ray:
            raise UsageError("`board` and `ray` are two things: on Ray every node offers its own boards")
        if not self.file and self.resume is None:
            raise UsageError("name a sweep file, or the folder of a sweep with `resume`")

    @property
    def source(self) -> Path:
        """Return the sweep file; raises UsageError where none has that name."""
        return self.resume / COPY if self.resume and not self.file else find_sweep(self.file)

    @cached_property
    def boards(self) -> tuple[str, ...] | None:
        """Return what this machine is called, now or when the sweep began; None where Ray knows. Raises StoreError."""
        if self.ray or self.board or self.resume is None:
            return None if self.ray else self.board
        return tuple(read_run(self.resume).manifest["configuration"].get("boards") or ())

    @property
    def width(self) -> int:
        return self.jobs or len(os.sched_getaffinity(0))
