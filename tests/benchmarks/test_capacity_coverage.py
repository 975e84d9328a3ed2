"""The benchmark of capacity's intervals simulates what it says and prints every setting."""

from __future__ import annotations

import pytest

from benchmarks import capacity_coverage


def test_a_server_of_20_ms_carries_16_robots_that_ask_every_16_ticks_of_20_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capacity_coverage, "RESAMPLES", 2)
    stalled = [capacity_coverage.interval("constant", "queue?trigger=8", robots, 10, 0) for robots in (16, 17)]
    assert stalled[0][0] == 0 < stalled[0][1]
    assert stalled[1][0] < 1 / 17 < stalled[1][1]
    assert capacity_coverage.predicted("constant", 0) == (16, 16, 16)


def test_every_setting_is_printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["capacity_coverage", "--trials", "2", "--searches", "1", "--sets", "1"])
    monkeypatch.setattr(capacity_coverage, "LONG_S", 10)
    monkeypatch.setattr(capacity_coverage, "LONG_RUNS", 1)
    monkeypatch.setattr(capacity_coverage, "RESAMPLES", 1)
    monkeypatch.setattr(capacity_coverage, "SERVICES", {"constant": capacity_coverage.SERVICES["constant"]})
    monkeypatch.setattr(capacity_coverage, "FLEETS", {"sync": {"constant": (4, 16)}})
    capacity_coverage.main()
    assert len([line for line in capsys.readouterr().out.splitlines() if "constant" in line]) == 4
