"""Checks of this machine before measuring: its state, possible improvements, distorting settings, and failures.

A check is a function of a `Machine` that returns one Finding, or None if it does not apply. It reads files below the
machine's root, its environment and its programs, so that tests run it on recorded trees; NVML and the packages of this
Python are read directly.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Literal, TypeAlias

from s2a_bench import extras
from s2a_bench.options import Options, option
from s2a_bench.store.manifest import RunWarning

Level: TypeAlias = Literal["state", "advice", "warning", "error"]
LEVELS: tuple[Level, ...] = ("state", "advice", "warning", "error")
"""State: a plain fact. Advice: makes results better or steadier. Warning: distorts results. Error: does not work."""

COMMAND_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check; ``fix``, a command or what to do, is there in every warning and error."""

    code: str
    level: Level
    message: str
    fix: str = ""


def _run(command: Sequence[str]) -> str | None:
    """Return the standard output of a program, None if it is missing, fails or hangs."""
    try:
        done = subprocess.run(  # noqa: S603 - the checks' own commands
            command, capture_output=True, text=True, errors="replace", check=False, timeout=COMMAND_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True, slots=True)
class Machine:
    """The inputs of checks; the defaults are this machine and this process."""

    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=lambda: os.environ)
    cpus: frozenset[int] = field(default_factory=lambda: frozenset(os.sched_getaffinity(0)))
    output: Path = Path("results")
    run: Callable[[Sequence[str]], str | None] = _run
    finds: Callable[[str], bool] = extras.installed

    def read(self, path: str) -> str | None:
        """Return a file's text without surrounding blanks and NULs; None if it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return None

    def number(self, path: str) -> int | None:
        try:
            return int(self.read(path) or "")
        except ValueError:
            return None

    def read_all(self, pattern: str) -> dict[str, str]:
        names = (str(path.relative_to(self.root)) for path in sorted(self.root.glob(pattern)))
        return {name: text for name in names if (text := self.read(name)) is not None}


Check: TypeAlias = Callable[[Machine], Finding | None]

CHECKS: dict[str, str] = {
    "python": "s2a_bench.machine.doctor.host:python",
    "packages": "s2a_bench.machine.doctor.host:packages",
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
"""Code of the findings -> check, in the order of the output; engines and transports declare more."""

BEFORE_RUN = "cpus", "cpu-governor", "jetson-clocks", "load", "temperature", "gpu-throttling", "clock-source", "disk"
"""The checks before every measurement: their findings distort its numbers or end it early."""


def examine(machine: Machine, checks: Mapping[str, str] = CHECKS) -> list[Finding]:
    """Run the checks (code -> ``module:function``) and return their findings."""
    results = (resolve_name(check)(machine) for check in checks.values())
    return [finding for finding in results if finding is not None]


def worst(findings: Iterable[Finding]) -> Level:
    return max((finding.level for finding in findings), key=LEVELS.index, default="state")


def warnings_of(findings: Iterable[Finding]) -> list[RunWarning]:
    return [RunWarning(each.code, each.message, each.fix) for each in findings if each.level in {"warning", "error"}]


class DoctorConfig(Options):
    output: Path = option(Path("results"), "folder for run folders, whose disk is checked")
    url: str = option("", "check an external server for what distorts a measurement of it, instead of this machine")
    strict: bool = option(False, "exit with 1 on warnings too")
