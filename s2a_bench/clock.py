"""Clocks: CLOCK_MONOTONIC for measuring, a virtual clock for tests and studies.

All times are integer nanoseconds. Times of two processes on one host are comparable because Linux keeps one
CLOCK_MONOTONIC per boot and time namespace; `clock_id` names it, so that times of two clocks are never subtracted.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final, Protocol

SWITCH_S: Final = 0.0005
"""Longest time that another thread of this process delays one that is due (Python's default: 5 ms)."""

now_ns = time.monotonic_ns


@cache
def clock_id() -> str:
    """Name this process's CLOCK_MONOTONIC: the kernel's boot id, and the offset of a time namespace that has one."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    offsets = Path("/proc/self/timens_offsets")  # Linux 5.6
    _, seconds, ns = offsets.read_text().splitlines()[0].split() if offsets.exists() else ("", "0", "0")
    return boot if seconds == ns == "0" else f"{boot}+{seconds}s{ns}ns"


def realtime_offset_ns() -> int:
    """Return CLOCK_REALTIME minus CLOCK_MONOTONIC, read between two readings of the latter."""
    before = now_ns()
    real = time.clock_gettime_ns(time.CLOCK_REALTIME)
    return real - (before + now_ns()) // 2


@contextmanager
def quick_switching() -> Iterator[None]:
    """Shorten the switch interval between threads to `SWITCH_S`."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class Clock(Protocol):
    """Reads the time and waits for a time."""

    def now_ns(self) -> int: ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at ``deadline_ns`` or at once if that is past."""


class SystemClock:
    """CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        return now_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep; returns late by the scheduler's latency, never early."""
        while (left := deadline_ns - now_ns()) > 0:
            time.sleep(left / 1e9)


class VirtualClock:
    """A clock without waiting: sleeping moves it to the deadline, never backwards."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)
