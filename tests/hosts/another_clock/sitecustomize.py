"""Gives every Python process that has this folder on its path another clock than this host's: a server's, in tests.

S2A_TEST_CLOCK is "OFFSET_NS PPM": the clock is that far ahead, and faster or slower by so much.
"""

import os
import time

from s2a_bench import clock

OFFSET_NS, PPM = map(int, os.environ["S2A_TEST_CLOCK"].split())


def now_ns() -> int:
    true_ns = time.monotonic_ns()
    return true_ns + OFFSET_NS + true_ns * PPM // 10**6


clock.now_ns = now_ns  # type: ignore[assignment]
clock.clock_id = lambda: "another host"  # type: ignore[assignment]
