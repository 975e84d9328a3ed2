"""Lines through measurements: held against what made them, and against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from s2a_bench.stats.line import Estimate, fit_line

SIZES = (0.15, 0.45, 0.9, 2.8, 6.2, 18.7)


def measured(
    seed: int, *, spread: float, fixed: float = 0.3, slope: float = 0.7, off: float = 0.0, launches: int = 4
) -> list[tuple[float, float]]:
    """Draw launches: each differs by ``spread``, and all of a size are ``off`` the line by the same share."""
    rng = np.random.default_rng(seed)
    times = [(x, (fixed + slope * x) * rng.lognormal(0, off)) for x in SIZES]
    return [(x, y * rng.lognormal(0, spread)) for x, y in times for _ in range(launches)]


def test_exact_values_give_their_line() -> None:
    line = fit_line([(x, 0.3 + 0.7 * x) for x in SIZES * 2])
    assert (line.fixed.value, line.slope.value, line.at(2)) == pytest.approx((0.3, 0.7, 1.7))
    assert line.fixed.ci95 == pytest.approx((0.3, 0.3))
    assert line.off == pytest.approx(0, abs=1e-9)


def test_it_minimises_relative_distances_of_the_sizes_geometric_means() -> None:
    launches = measured(3, spread=0.3)
    line = fit_line(launches)
    y = np.exp([np.mean([np.log(y) for x, y in launches if x == size]) for size in SIZES])
    found = least_squares(lambda at: (at[0] + at[1] * np.array(SIZES)) / y - 1, (1, 1), xtol=1e-14, ftol=1e-14)
    assert (line.fixed.value, line.slope.value) == pytest.approx(tuple(found.x), rel=1e-6)
    assert line.off == pytest.approx(np.sqrt(np.mean(np.square(found.fun))))


@pytest.mark.parametrize("launches", [1, 4])
@pytest.mark.parametrize("spread", [0.05, 0.13])
@pytest.mark.parametrize("off", [0.0, 0.2])
def test_intervals_cover_what_made_the_values(launches: int, spread: float, off: float) -> None:
    held = np.zeros(2)
    for seed in range(400):
        line = fit_line(measured(seed, spread=spread, off=off, launches=launches))
        held += [holds(line.fixed, 0.3), holds(line.slope, 0.7)]
    assert (np.abs(held / 400 - 0.95) < 0.035).all()


def holds(found: Estimate, value: float) -> bool:
    return found.ci95[0] <= value <= found.ci95[1]


def test_no_line_without_two_sizes_and_no_interval_without_three() -> None:
    assert fit_line([]) is None
    assert fit_line([(1.0, 1.0), (1.0, 2.0)]) is None
    line = fit_line([(1.0, 1.0), (3.0, 2.0)])
    assert (line.fixed.value, line.slope.value) == pytest.approx((0.5, 0.5))
    assert line.fixed.ci95 is line.slope.ci95 is None


def test_what_is_no_line_says_so() -> None:
    line = fit_line([(x, 1 + x**2) for x in SIZES])
    assert line.off > 0.3


@pytest.mark.parametrize("spread", [0.05, 0.13])
def test_a_new_point_lies_within_reach_of_the_line(spread: float) -> None:
    held, at = 0, 1.5
    for seed in range(400):
        line = fit_line(measured(seed, spread=spread, launches=1))
        reach = line.reach(at)
        new = (0.3 + 0.7 * at) * np.random.default_rng(seed + 1000).lognormal(0, spread)
        held += abs(new - line.at(at)) <= reach
    assert abs(held / 400 - 0.95) < 0.035
    two_points = fit_line([(1, 1.0), (2, 1.5)])
    assert two_points.reach(1) is None
