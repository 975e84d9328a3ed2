"""Hostile and normal clients together, for seconds: `python -m benchmarks.soak` takes ten minutes."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.soak import soak


@pytest.mark.slow
@pytest.mark.parametrize(("transport", "minutes"), [("http", 0.1), ("websocket", 0.05), ("zmq", 0.1)])
def test_normal_clients_are_answered_and_nothing_is_left(transport: str, minutes: float, tmp_path: Path) -> None:
    result = soak(transport, "echo", minutes, tmp_path / "log")
    assert result.broken() == [], result.failed[:3]
    assert result.attacks > 10
