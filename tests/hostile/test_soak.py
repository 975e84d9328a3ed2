"""Hostile and honest clients together for less than a minute: `python -m benchmarks.soak` has no such limit."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from benchmarks.soak import HOSTILE, SLOWER, result_json, served, soak, told
from s2a_bench.testing.hostile.usage import usage


def test_bodies_that_no_framework_lets_go_are_not_kept(tmp_path: Path) -> None:
    """FastAPI's errors hold the body, in cycles that Python looks for when it likes; grown blocks stay in the heap."""
    (big,) = (case for case in HOSTILE["http"] if case.name == "64 MiB of spaces")
    with served("http", "echo", "big", tmp_path / "log") as server:
        before = usage(server.process.pid)
        for _ in range(8):
            big.does(told("http", server.address))
        deadline = time.monotonic() + 30
        while usage(server.process.pid).rss_mib > before.rss_mib + 100 and time.monotonic() < deadline:
            time.sleep(0.2)
        assert usage(server.process.pid).rss_mib < before.rss_mib + 100


@pytest.mark.slow
@pytest.mark.parametrize("transport", [*HOSTILE])
def test_no_promise_is_broken_within_a_minute(transport: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    result = soak(transport, "echo", float(os.environ.get("S2A_SOAK_MINUTES", "0.5")), log, blocks=5)
    result.slower_low = min(result.slower_low or 0.0, SLOWER)  # whatever the machine does beside this
    whole = result_json(result)
    assert whole["broken"] == [], log.read_text()[-3000:]
    assert whole["asked"] > 50
    assert whole["attacks"] > 50
