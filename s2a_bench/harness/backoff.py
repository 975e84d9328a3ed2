"""Waiting as a server asks: a run that was refused asks again later, not at once."""

from __future__ import annotations

from collections.abc import Callable

from s2a_bench.clock import Clock

LONGEST_S = 60.0
"""The longest wait; a server that wants more refuses again after it, and soon ends the run that way."""


class Backoff:
    """Waits between samples, never inside one."""

    def __init__(self, clock: Clock, say: Callable[[str], None]) -> None:
        """Wait on a clock, and say so."""
        self._clock = clock
        self._say = say

    def wait(self, cell: str, retry_after_s: float) -> None:
        """Let ``retry_after_s`` pass, or `LONGEST_S` if that is less; nothing for 0."""
        if not retry_after_s:
            return
        wait_s = min(retry_after_s, LONGEST_S)
        self._say(f"waiting {wait_s:g} s, as the server of {cell} asks")
        self._clock.sleep_until_ns(self._clock.now_ns() + int(wait_s * 1e9))
