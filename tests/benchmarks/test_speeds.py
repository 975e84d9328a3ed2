"""The benchmarks of speed print a line for each thing that they time."""

from __future__ import annotations

from types import ModuleType

import pytest

from benchmarks import chunk_speed, policy_speed, start_up


@pytest.mark.parametrize(
    ("benchmark", "flags", "titles"),
    [
        (chunk_speed, ["--seconds", "0.001"], list(chunk_speed.MODES)),
        (policy_speed, ["--seconds", "0.001"], [""] * 8),
        (start_up, ["--times", "1"], list(start_up.STARTS)),
    ],
)
def test_a_line_a_thing(
    benchmark: ModuleType,
    flags: list[str],
    titles: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark", *flags])
    monkeypatch.setattr(chunk_speed, "REQUESTS", 200)
    monkeypatch.setattr(chunk_speed, "STEPPED", 20)
    benchmark.main()
    _, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(titles)
    for line, title in zip(lines, titles, strict=True):
        assert float(line.split()[0]) >= 0
        assert line.endswith(title)
