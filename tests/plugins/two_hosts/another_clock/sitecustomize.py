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

if "S2A_TEST_MARKS" in os.environ:  # each report's marks go to this file, too
    import json
    from pathlib import Path

    from s2a_bench import trace

    to_remote = trace.Trace.to_remote

    def to_remote_and_file(self: trace.Trace) -> trace.Remote:
        with Path(os.environ["S2A_TEST_MARKS"]).open("a", encoding="utf-8") as file:
            file.write(json.dumps(self.marks) + "\n")
        return to_remote(self)

    trace.Trace.to_remote = to_remote_and_file  # type: ignore[method-assign]
