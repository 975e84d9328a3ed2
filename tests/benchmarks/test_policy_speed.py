"""The benchmark of the policies measures what it says."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import policy_speed
from benchmarks.evaluate import evaluate


def test_the_plain_loop_that_is_raced_computes_the_same_numbers() -> None:
    rng = np.random.default_rng(2)
    arrival_s, duration_s = np.cumsum(rng.uniform(0, 2, (9, 20)), axis=0), rng.uniform(0.3, 1.3, (9, 20))
    found = evaluate(arrival_s, duration_s)
    columns = (
        found.safe_start_s,
        found.end_s,
        found.wait_end_s,
        found.naive_stalls,
        found.naive_stall_s,
        found.naive_longest_stall_s,
    )
    for i in range(20):
        plain = policy_speed._plain(arrival_s[:, i].tolist(), duration_s[:, i].tolist())
        assert plain == pytest.approx([column[i] for column in columns], abs=1e-12)


def test_every_line_is_printed_with_its_speed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["policy_speed", "--seconds", "0.001"])
    policy_speed.main()
    first, *lines = capsys.readouterr().out.splitlines()
    assert "N = 32, float64, one core" in first
    assert len(lines) == 8
    assert all(float(line.split()[0]) > 0 for line in lines)
