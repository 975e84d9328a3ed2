"""How all middlewares wait for a peer to appear, and how long one wait may keep Python from Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, Protocol

from s2a_bench.clock import now_ns

WAIT_SLICE_NS: Final = 500_000_000
"""A blocked wait returns to Python this often, so that Ctrl-C acts."""
MATCH_POLL_S: Final = 0.01
"""rclpy's own waiting looks four times a second."""


class Waits(Protocol):
    """Waits for anything to arrive."""

    interrupted: bool

    def wait_until(self, deadline_ns: int, /) -> bool:
        """Return after data, a time slice or an interrupt; False once the deadline or an interrupt has come."""
        ...

    def interrupt(self) -> None:
        """End a wait under way and every later one; callable from any thread."""
        ...


def appeared(present: Callable[[], bool], timeout_s: float, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Look every 10 ms whether somebody is there; False after ``timeout_s``, or where it is given up."""
    deadline_ns = now_ns() + int(timeout_s * 1e9)
    while not present():
        if now_ns() > deadline_ns or given_up():
            return False
        time.sleep(MATCH_POLL_S)
    return True
