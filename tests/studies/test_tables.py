"""What a study's rows come to, on rows written by hand."""

from __future__ import annotations

import pandas as pd
import pytest
from scipy.stats import binom

from studies.tables import regret_at
from studies.targets import ONLINE, targets_of


def rows(*cells: tuple[float, int, float, float]) -> pd.DataFrame:
    """Make rows of (rho, stalled of 1000 plans, start regret, end regret)."""
    frame = pd.DataFrame(cells, columns=["rho", "stalled", "start_regret", "end_regret"])
    return frame.assign(policy=ONLINE, plans=1000, p_any_stall=frame["stalled"] / 1000)


def test_targets_are_judged_over_all_settings_and_over_the_hard_ones() -> None:
    found = {
        each.what: each for each in targets_of(rows((0.5, 0, 0.0, 0.0), (0.9, 21, 0.12, 0.09), (2.0, 3, 0.0, 0.02)))
    }
    assert found["P(any stall), worst setting"].value == 0.021
    assert not found["P(any stall), worst setting"].met
    high = found["P(any stall), pooled, upper end of 95 %"].value
    assert binom.cdf(24, 3000, high) == pytest.approx(0.025)  # Clopper and Pearson's definition
    assert high == pytest.approx(0.0119, abs=1e-4)
    assert not found["P(any stall), pooled, upper end of 95 %"].met
    assert found["start regret, all settings"].value == pytest.approx(0.04)
    assert found["start regret, all settings"].met
    assert found["start regret, rho > .8"].value == pytest.approx(0.06)
    assert not found["start regret, rho > .8"].met
    assert found["end regret, all settings"].value == pytest.approx(0.11 / 3)
    assert found["end regret, rho > .8"].value == pytest.approx(0.055)
    assert found["end regret, rho > .8"].met


def test_a_frontier_is_read_between_its_points_and_never_dearer_than_a_safer_one() -> None:
    frontier = rows((1.0, 100, 0.2, 0.0), (1.0, 0, 1.0, 0.0), (1.0, 50, 0.4, 0.0), (1.0, 60, 0.9, 0.0))
    assert regret_at(frontier, 0.0) == 1.0
    assert regret_at(frontier, 0.025) == pytest.approx(0.7)
    assert regret_at(frontier, 0.06) == pytest.approx(0.4)  # the point at 60 is dominated
    assert regret_at(frontier, 0.5) == 0.2
