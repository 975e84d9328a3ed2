"""Lines through measurements: held against what made them, and against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from s2a_bench.stats.line import crossing, fit_line

SIZES = (0.15, 0.45, 0.9, 2.8, 6.2, 18.7)


def measured(
    fixed: float, slope: float, seed: int, *, noise: float = 0.1, n: int = 30
) -> list[tuple[float, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [(x, (fixed + slope * x) * rng.lognormal(0, noise, n)) for x in SIZES]


def test_exact_values_give_their_line() -> None:
    line = fit_line([(x, np.full(5, 0.3 + 0.7 * x)) for x in SIZES])
    assert line is not None
    assert (line.fixed.value, line.slope.value) == pytest.approx((0.3, 0.7))
    assert (line.fixed.low, line.fixed.high, line.off) == pytest.approx((0.3, 0.3, 0), abs=1e-9)
    assert line.at(2) == pytest.approx(1.7)


def test_it_minimises_relative_distances() -> None:
    groups = measured(0.3, 0.7, 3, noise=0.3)
    line = fit_line(groups)
    assert line is not None
    x = np.array([x for x, _ in groups])
    y = np.array([np.median(values) for _, values in groups])
    found = least_squares(lambda at: (at[0] + at[1] * x) / y - 1, (1.0, 1.0), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert (line.fixed.value, line.slope.value) == pytest.approx(tuple(found.x), rel=1e-6)


def test_intervals_cover_what_made_the_values() -> None:
    lines = [fit_line(measured(0.3, 0.7, seed), seed) for seed in range(200)]
    covered = [
        (line.fixed.low <= 0.3 <= line.fixed.high, line.slope.low <= 0.7 <= line.slope.high) for line in lines if line
    ]
    assert len(covered) == 200
    shares = np.mean(covered, 0)
    assert (shares > 0.88).all()  # 95 % less what a bootstrap of medians of 30 falls short, and 200 draws' chance
    assert (shares <= 1).all()


def test_launches_that_differ_widen_the_intervals() -> None:
    rng = np.random.default_rng(1)
    alike = [(x, (1 + x) * rng.lognormal(0, 0.05, 30)) for x in SIZES for _ in range(4)]
    unlike = [(x, (1 + x) * rng.lognormal(rng.normal(0, 0.2), 0.05, 30)) for x in SIZES for _ in range(4)]
    narrow, wide = fit_line(alike), fit_line(unlike)
    assert narrow is not None
    assert wide is not None
    assert wide.slope.high - wide.slope.low > 5 * (narrow.slope.high - narrow.slope.low)


def test_intervals_over_launches_cover_what_made_them() -> None:
    covered = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        groups = [(x, (0.3 + 0.7 * x) * rng.lognormal(rng.normal(0, 0.1), 0.05, 20)) for x in SIZES for _ in range(4)]
        line = fit_line(groups, seed)
        assert line is not None
        covered.append((line.fixed.low <= 0.3 <= line.fixed.high, line.slope.low <= 0.7 <= line.slope.high))
    assert (np.mean(covered, 0) > 0.8).all()  # four launches show less spread than there is: 95 % are not reached


def test_no_line_without_two_sizes() -> None:
    assert fit_line([]) is None
    assert fit_line([(1.0, np.ones(3)), (1.0, np.ones(3)), (2.0, np.ones(0))]) is None


def test_what_is_no_line_says_so() -> None:
    line = fit_line([(x, np.full(5, 1 + x**2)) for x in SIZES])
    assert line is not None
    assert line.off > 0.3


def test_two_lines_cross_where_they_do() -> None:
    one, other = fit_line(measured(0.3, 0.7, 1, noise=0.02)), fit_line(measured(1.3, 0.2, 2, noise=0.02))
    assert one is not None
    assert other is not None
    met = crossing(one, other)
    assert met is not None
    assert met.low < 2 < met.high
    assert met.high - met.low < 0.5
    back = crossing(other, one)
    assert back is not None
    assert back.value == pytest.approx(met.value)


def test_lines_beside_each_other_do_not_cross() -> None:
    one, other = fit_line(measured(0.3, 0.7, 1, noise=0.02)), fit_line(measured(1.3, 0.9, 2, noise=0.02))
    assert one is not None
    assert other is not None
    assert crossing(one, other) is None
    assert crossing(one, one) is None


def test_a_crossing_that_few_draws_have_is_none() -> None:
    one, other = fit_line(measured(0.3, 0.7, 1, noise=0.5, n=8)), fit_line(measured(0.31, 0.69, 2, noise=0.5, n=8))
    assert one is not None
    assert other is not None
    assert crossing(one, other) is None
