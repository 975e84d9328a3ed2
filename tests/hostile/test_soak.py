"""Hostile and honest clients together for less than a minute: `python -m benchmarks.soak` has no such limit."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.soak import SLOWER, result_json, soak


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["http", "ros"])
def test_no_promise_is_broken_within_a_minute(transport: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    result = soak(transport, "echo", float(os.environ.get("S2A_SOAK_MINUTES", "0.5")), log, blocks=5)
    result.slower_low = min(result.slower_low or 0.0, SLOWER)  # whatever the machine does beside this
    whole = result_json(result)
    assert whole["broken"] == [], log.read_text()[-3000:]
    assert whole["asked"] > 50
    assert whole["attacks"] > 50
