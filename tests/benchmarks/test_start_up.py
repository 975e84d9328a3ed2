"""The benchmark of the start starts what it says."""

from __future__ import annotations

import pytest

from benchmarks import start_up


def test_every_start_is_printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["start_up", "--times", "1"])
    start_up.main()
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split(maxsplit=3)[3] for line in lines] == list(start_up.STARTS)
    assert all(float(line.split()[0]) > 0 for line in lines)
