"""The smallest change that a test could have seen, against simulated repeats and the textbook."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.ratio_coverage import power
from s2a_bench.stats.batches import Rows
from s2a_bench.stats.change import Noise, change_between


@pytest.mark.parametrize(("launches", "spread"), [(3, 0.08), (5, 0.04), (10, 0.13)])
def test_the_smallest_change_is_found_in_four_of_five_repeats(launches: int, spread: float) -> None:
    noise = Noise(spread * math.sqrt(2 / launches), 2 * launches - 2)
    smallest = noise.detectable(0.05)
    rng = np.random.default_rng(3)
    first = rng.normal(0, spread, (4000, launches))
    second = rng.normal(math.log1p(smallest), spread, (4000, launches))
    found = stats.ttest_ind(first, second, axis=1).pvalue < 0.05
    assert found.mean() == pytest.approx(0.8, abs=0.02)
    assert power(noise, smallest) == pytest.approx(0.8, abs=0.005)


def test_a_fall_is_the_same_factor_and_a_stricter_level_sees_less() -> None:
    noise = Noise(0.05, 8)
    rise, fall = noise.detectable(0.05), noise.detectable(0.05, falls=True)
    assert (1 + rise) * (1 - fall) == pytest.approx(1)
    assert noise.detectable(0.05 / 10) > rise
    assert Noise(0.05, 8, logarithmic=False).detectable(0.05) == pytest.approx(math.log1p(rise))


def test_what_does_not_vary_hides_nothing_and_much_noise_stays_a_number() -> None:
    assert Noise(0.0, math.inf).detectable(0.05) == 0
    assert math.isfinite(Noise(9.0, 1).detectable(0.05 / 48))


def test_power_is_that_of_a_share_where_there_is_no_logarithm() -> None:
    noise = Noise(0.05, 8, logarithmic=False)
    smallest = noise.detectable(0.05)
    assert power(noise, smallest) == pytest.approx(0.8, abs=0.005)
    assert power(noise, -smallest) == pytest.approx(0.8, abs=0.005)


def test_the_noise_of_a_change_is_that_of_its_test() -> None:
    rng = np.random.default_rng(2)
    sides = [[Rows(rng.lognormal(0, 0.1, 20)) for _ in range(5)] for _ in range(2)]
    change = change_between(*sides, "median", seed=0)
    reach = float(stats.t.ppf(0.975, change.noise.freedom)) * change.noise.error
    assert math.log(change.ratio.value / change.ratio.low) == pytest.approx(reach)
    few = [[Rows(rng.lognormal(0, 0.1, 3))] for _ in range(2)]
    assert change_between(*few, "median", seed=0).noise is None
