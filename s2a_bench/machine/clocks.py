"""The wall clock, and how far it may be off, as programs of this host know that installed packages ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from s2a_bench.registry import Registry

REALTIME_MS, REALTIME_ERROR_MS = "realtime_ms", "realtime_error_ms"
"""Facts: CLOCK_REALTIME less CLOCK_MONOTONIC, and the most that the former is off."""


class WallClock(NamedTuple):
    """CLOCK_REALTIME less CLOCK_MONOTONIC, the most that the former is off, and when that was read."""

    offset_ns: int
    error_ns: int
    read_ns: int


WALL_CLOCKS: Final[Registry[Callable[[], WallClock]]] = Registry("wall_clocks", "clock", {})
"""Service that knows the clock's error -> a function that reads both; raises RequestFailed if it knows nothing."""
