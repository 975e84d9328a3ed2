"""Hostile and normal clients together, for seconds: `python -m benchmarks.soak` takes ten minutes."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.soak import soak


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["http", "zmq"])
def test_normal_clients_are_answered_and_nothing_is_left(transport: str, tmp_path: Path) -> None:
    result = soak(transport, "echo", 0.1, tmp_path / "log")
    assert result.broken() == [], result.failed[:3]
    assert result.attacks > 10


@pytest.mark.slow
def test_so_they_are_over_websocket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for growth, which seconds do not tell: of the largest messages the allocator keeps two, or none."""
    monkeypatch.setattr("benchmarks.soak.SETTLES_S", 15.0)
    result = soak("websocket", "echo", 0.05, tmp_path / "log")
    assert [line for line in result.broken() if not line.startswith("the memory grew")] == [], result.failed[:3]
    assert result.attacks > 10
