"""The floor of `return` is measured, and every pipeline of the run is held against it."""

from __future__ import annotations

import re
import sys

import pytest

from benchmarks import wakeups


@pytest.mark.slow
def test_each_pipeline_has_a_line_against_the_floor(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["wakeups", "http/binary,loopback"])
    monkeypatch.setattr(
        wakeups, "OPTIONS", ("--payload", "raw", "--launches", "1", "--requests", "5", "--size", "64x48")
    )
    wakeups.main()
    first, *lines = capfd.readouterr().out.splitlines()
    floor = re.match(r"floor: (\d\.\d{3}) ms, two wake-ups of ", first)
    assert floor
    assert float(floor[1]) > 0
    for line, name in zip(lines, ("http/binary", "loopback"), strict=True):
        took = re.fullmatch(rf"{name} +return (\d+\.\d{{3}}) ms, ([+-]\d+\.\d{{3}}) above the floor", line)
        assert took
        assert float(took[1]) - float(floor[1]) == pytest.approx(float(took[2]), abs=0.002)
