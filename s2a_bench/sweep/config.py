"""What is asked of a sweep: its file or its folder, and where its cells run."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

from s2a_bench.errors import UsageError
from s2a_bench.options import Names, Options, option


class SweepConfig(Options):
    """A sweep to start, or one to go on with."""

    file: str = option(
        "", "sweep file (TOML), or the name of one: paper, quick, transports; not needed with --resume", argument=True
    )
    resume: Path | None = option(None, "folder of a sweep that was interrupted: run what it has not run yet")
    retry_failed: bool = option(False, "with --resume: run the cells that failed once more")
    dry_run: bool = option(False, "print the cells and how long they will take, and run nothing")
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
        from s2a_bench.sweep.file import find_sweep
        from s2a_bench.sweep.run import COPY

        return self.resume / COPY if self.resume and not self.file else find_sweep(self.file)

    @cached_property
    def boards(self) -> tuple[str, ...] | None:
        """Return what this machine is called, now or when the sweep began; None where Ray knows. Raises StoreError."""
        from s2a_bench.store.run import read_run

        if self.ray or self.board or self.resume is None:
            return None if self.ray else self.board
        return tuple(read_run(self.resume).manifest["configuration"].get("boards") or ())

    @property
    def width(self) -> int:
        """Return how many virtual cells run at once on this machine."""
        return self.jobs or len(os.sched_getaffinity(0))
