"""The benchmark of intervals simulates what it says and prints every setting."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import ratio_coverage


def test_the_simulated_cells_have_the_ratio_and_the_spread_that_are_asked_for() -> None:
    above, below = ratio_coverage.simulate(np.random.default_rng(1), 4000, 0.08, 0.4, 60_000)
    logs = np.log(np.median(above, axis=1) / np.median(below, axis=1))
    assert above.shape == below.shape == (4000, 15)
    assert np.exp(logs.mean()) == pytest.approx(ratio_coverage.RATIO, rel=0.01)
    assert logs.std() > 0.08


def test_every_setting_is_printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["ratio_coverage", "--trials", "20"])
    monkeypatch.setattr(ratio_coverage, "FEWEST", 3)
    ratio_coverage.main()
    printed = capsys.readouterr().out.splitlines()
    assert len([line for line in printed if "--launches" in line]) == 9
    assert len([line for line in printed if "a side" in line]) == 12 + 20
