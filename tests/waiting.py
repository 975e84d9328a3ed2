"""Waiting for what another thread or process brings about."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Event

from s2a_bench.clock import now_ns


def until(met: Callable[[], object], seconds: float = 20) -> None:
    """Wait until a condition holds; fail the test if it does not in time."""
    deadline = now_ns() + round(seconds * 1e9)
    while not met():
        assert now_ns() < deadline, "it did not come about"
        Event().wait(0.005)


def ended(pid: int) -> bool:
    """Return whether a process has ended, reaped or not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True
