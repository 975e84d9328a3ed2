"""Checks of this machine before measuring: what is, what could be better, what distorts results, what cannot work.

A check is a function of a `Machine` that returns one Finding, or None where it has nothing to look at. It reads files
below the machine's root, its environment and its programs, so that tests run it on recorded trees; NVML and the
packages of this Python are asked as they are.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Literal, TypeAlias

from s2a_bench import extras
from s2a_bench.options import Options, option
from s2a_bench.store.manifest import RunWarning

if TYPE_CHECKING:
    from s2a_bench.frames.v4l2 import CameraInfo

Level: TypeAlias = Literal["state", "advice", "warning", "error"]
LEVELS: tuple[Level, ...] = ("state", "advice", "warning", "error")
"""State: as it should be, or simply so. Advice: would make results better or steadier. Warning: distorts results.
Error: what the check is about does not work."""

COMMAND_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check saw; ``fix`` is the command that changes it, and every warning and error has one."""

    code: str
    level: Level
    message: str
    fix: str = ""


def _run(command: Sequence[str]) -> str | None:
    """Return what a program prints on standard output, None where it is missing, fails or hangs."""
    try:
        done = subprocess.run(  # noqa: S603 - the checks' own commands
            command, capture_output=True, text=True, errors="replace", check=False, timeout=COMMAND_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _cameras() -> list[CameraInfo]:
    """List this machine's cameras; their module brings OpenCV, which a run's checks do not need."""
    from s2a_bench.frames.v4l2 import list_cameras

    return list_cameras()


@dataclass(frozen=True, slots=True)
class Machine:
    """Everything that checks may look at; the defaults are this machine and this process."""

    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=lambda: os.environ)
    cpus: frozenset[int] = field(default_factory=lambda: frozenset(os.sched_getaffinity(0)))
    output: Path = Path("results")
    """Where run folders go."""
    run: Callable[[Sequence[str]], str | None] = _run
    which: Callable[[str], str | None] = shutil.which
    finds: Callable[[str], bool] = extras.installed
    """Whether this Python has a package."""
    cameras: Callable[[], list[CameraInfo]] = _cameras

    def read(self, path: str) -> str | None:
        """Return a file's text without blanks and NULs around it; None where it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return None

    def number(self, path: str) -> int | None:
        """Return the number in a file; None where there is none."""
        try:
            return int(self.read(path) or "")
        except ValueError:
            return None

    def read_all(self, pattern: str) -> dict[str, str]:
        """Return the texts of the files that match, by path below the root."""
        found = (str(path.relative_to(self.root)) for path in sorted(self.root.glob(pattern)))
        return {name: text for name in found if (text := self.read(name)) is not None}


Check: TypeAlias = Callable[[Machine], Finding | None]

CHECKS: dict[str, str] = {
    "python": "s2a_bench.machine.doctor.software:python",
    "packages": "s2a_bench.machine.doctor.software:packages",
    "compiler": "s2a_bench.machine.doctor.software:compiler",
    "board": "s2a_bench.machine.doctor.gpu:board",
    "gpu": "s2a_bench.machine.doctor.gpu:gpu",
    "gpu-throttling": "s2a_bench.machine.doctor.gpu:gpu_throttling",
    "power-mode": "s2a_bench.machine.doctor.gpu:power_mode",
    "jetson-clocks": "s2a_bench.machine.doctor.gpu:jetson_clocks",
    "cpus": "s2a_bench.machine.doctor.host:cpus",
    "cpu-governor": "s2a_bench.machine.doctor.host:governor",
    "cpu-turbo": "s2a_bench.machine.doctor.host:turbo",
    "load": "s2a_bench.machine.doctor.host:load",
    "cpu-throttling": "s2a_bench.machine.doctor.host:throttling",
    "temperature": "s2a_bench.machine.doctor.host:temperature",
    "clock-source": "s2a_bench.machine.doctor.host:clock_source",
    "memory": "s2a_bench.machine.doctor.host:memory",
    "disk": "s2a_bench.machine.doctor.host:disk",
    "cameras": "s2a_bench.machine.doctor.host:cameras",
}
"""Code of the findings -> check, in the order in which they are shown; engines and transports declare their own."""

BEFORE_RUN = (
    *("cpus", "cpu-governor", "jetson-clocks", "load", "temperature", "gpu-throttling", "clock-source", "disk"),
)
"""The checks that concern every measurement: those whose trouble distorts its numbers or ends it half-way."""


def examine(machine: Machine, checks: Mapping[str, str] = CHECKS) -> list[Finding]:
    """Make the checks (code -> ``module:function``); those with nothing to look at are left out."""
    found = (resolve_name(check)(machine) for check in checks.values())
    return [finding for finding in found if finding is not None]


def worst(findings: Iterable[Finding]) -> Level:
    """Return the most severe level."""
    return max((finding.level for finding in findings), key=LEVELS.index, default="state")


def warnings_of(findings: Iterable[Finding]) -> list[RunWarning]:
    """Return the warnings and errors as runs store them."""
    return [RunWarning(seen.code, seen.message, seen.fix) for seen in findings if seen.level in {"warning", "error"}]


class DoctorConfig(Options):
    """How a machine is examined."""

    output: Path = option(Path("results"), "folder for run folders, whose disk is looked at")
    url: str = option("", "instead of this machine, a server that somebody else runs: what it does that is dangerous")
    strict: bool = option(False, "exit with 1 on warnings too")
