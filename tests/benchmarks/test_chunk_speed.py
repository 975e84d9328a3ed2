"""The benchmark of the modes prints each of them."""

from __future__ import annotations

import pytest

from benchmarks import chunk_speed


def test_every_mode_is_printed_with_its_speeds(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["chunk_speed", "--seconds", "0.001"])
    monkeypatch.setattr(chunk_speed, "REQUESTS", 200)
    monkeypatch.setattr(chunk_speed, "STEPPED", 20)
    chunk_speed.main()
    first, *lines = capsys.readouterr().out.splitlines()
    assert "H = 16, 50 Hz" in first
    assert [line.split()[-1] for line in lines] == list(chunk_speed.MODES)
    assert all(float(number) >= 0 for line in lines for number in line.split()[:-1])
