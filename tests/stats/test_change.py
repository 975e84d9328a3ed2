"""The comparison of two sides, on synthetic launches: level, power, and every effect size by hand."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter

from s2a_bench.stats.batches import LaunchValues, RowCorrelation, Rows, ranks_of
from s2a_bench.stats.change import Noise, change_between, change_of_ranks, holm

Floats: TypeAlias = NDArray[np.float64]
LEVEL = 0.05
REPEATS = 100


def rows_of(values: object) -> Rows:
    return Rows(np.asarray(values, dtype=np.float64))


def launch(rng: np.random.Generator, n: int, correlation: float, spread: float = 0.15, trend: float = 0.0) -> Floats:
    """Draw lognormal latencies whose neighbours are alike (AR(1)), over a slow swing of the machine."""
    noise = rng.standard_normal(n + 300) * math.sqrt(1 - correlation**2)
    series = np.asarray(lfilter([1], [1, -correlation], noise)[300:])
    swing = trend * np.sin(2 * np.pi * (np.arange(n) / n * 2 + rng.random()))
    return np.asarray(10 * np.exp(spread * series + swing))


def found(n: int, correlation: float, trend: float, factor: float, statistic: str = "median") -> int:
    """Count the repeats that find a change."""
    rng = np.random.default_rng(20)
    times = 0
    for seed in range(REPEATS):
        first, second = (rows_of(launch(rng, n, correlation, trend=trend) * by) for by in (1.0, factor))
        p = change_between([first], [second], statistic, seed=seed).p
        times += p < LEVEL
    return times


@pytest.mark.parametrize(
    ("n", "correlation", "trend", "statistic"),
    [
        (50, 0.0, 0.0, "median"),
        (100, 0.3, 0.0, "median"),
        (200, 0.5, 0.0, "median"),
        (200, 0.0, 0.1, "median"),
        (1000, 0.8, 0.05, "median"),
        (1000, 0.5, 0.0, "p99"),
        (200, 0.5, 0.0, "mean"),
    ],
)
def test_two_launches_of_the_same_thing_differ_at_most_as_often_as_the_level_says(
    n: int, correlation: float, trend: float, statistic: str
) -> None:
    # Binomial(100, 0.05) is above 9 in 3 of 100 cases; the seeds are fixed.
    assert found(n, correlation, trend, 1.0, statistic) <= 9


@pytest.mark.parametrize(("n", "correlation", "least"), [(200, 0.0, 95), (200, 0.5, 80), (1000, 0.8, 90)])
def test_a_slowdown_of_ten_per_cent_is_found(n: int, correlation: float, least: int) -> None:
    assert found(n, correlation, 0.0, 1.1) >= least


def test_launches_that_differ_by_themselves_are_judged_by_launches() -> None:
    rng = np.random.default_rng(3)
    by_launch = by_request = 0
    for seed in range(REPEATS):
        sides = [[rows_of(launch(rng, 50, 0.2, 0.05) * rng.lognormal(0, 0.08)) for _ in range(5)] for _ in range(2)]
        many = change_between(*sides, "median", seed=seed).p
        one = change_between(sides[0][:1], sides[1][:1], "median", seed=seed).p
        by_launch += many < LEVEL
        by_request += one < LEVEL
    assert by_launch <= 9
    assert by_request > 50  # one launch a side cannot know how launches differ: docs/compare.md says so


def test_several_launches_are_welchs_t_of_the_logarithms_of_their_medians() -> None:
    first, second = [[8.0, 10, 12], [11.0, 11, 11], [9.0, 9, 30]], [[12.0, 12, 12], [14.0, 14, 14], [13.0, 1, 99]]
    change = change_between([rows_of(v) for v in first], [rows_of(v) for v in second], "median", seed=0)
    test = stats.ttest_ind(np.log([12, 14, 13]), np.log([10, 11, 9]), equal_var=False)
    low, high = test.confidence_interval(0.95)
    assert change.p == pytest.approx(test.pvalue)
    assert change.ratio.value == pytest.approx((12 * 14 * 13 / 990) ** (1 / 3))
    assert (change.ratio.low, change.ratio.high) == (pytest.approx(math.exp(low)), pytest.approx(math.exp(high)))
    assert change.baseline == pytest.approx(990 ** (1 / 3))
    assert change.superiority.low is None


def test_the_means_of_ten_batches_of_one_value_are_compared_as_welchs_t_does() -> None:
    # Neighbours are unlike, so nothing is hidden; below zero there is no logarithm.
    first, second = (np.array([1, 9, 2, 8, 3, 7, 4, 6, 5, 5]) * by - 20.0 for by in (1, 1.4))
    change = change_between([rows_of(first)], [rows_of(second)], "mean", seed=1)
    test = stats.ttest_ind(second, first, equal_var=False)
    low, high = test.confidence_interval(0.95)
    assert change.ratio.low is None
    assert change.difference.value == pytest.approx(2)
    assert change.p == pytest.approx(test.pvalue, rel=0.15)  # the variance is that of 1000 resamples
    assert (change.difference.low, change.difference.high) == (
        pytest.approx(low, abs=0.2),
        pytest.approx(high, abs=0.2),
    )
    assert change.relative == pytest.approx(2 / 15)
    reach = float(stats.t.ppf(0.975, change.noise.freedom)) * change.noise.error * 15  # a share of the baseline, -15
    assert change.difference.high == pytest.approx(2 + reach)
    assert not change.noise.logarithmic


def test_interval_and_p_value_agree() -> None:
    rng = np.random.default_rng(8)
    for seed in range(40):
        change = change_between(
            [rows_of(launch(rng, 60, 0.3))], [rows_of(launch(rng, 60, 0.3) * 1.06)], "median", seed=seed
        )
        assert (change.p < LEVEL) == (not change.bounds[0] <= 0 <= change.bounds[1])


def test_sides_changed_over_turn_the_ratio_over() -> None:
    rng = np.random.default_rng(1)
    sides = [[rows_of(launch(rng, 400, 0.2))], [rows_of(launch(rng, 400, 0.2) * 1.2)]]
    there, back = (change_between(*order, "median", seed=1) for order in (sides, sides[::-1]))
    assert back.ratio.value == pytest.approx(1 / there.ratio.value)
    assert back.difference.value == -(there.difference.value or 0)
    assert back.superiority.value == pytest.approx(1 - (there.superiority.value or 0))


def test_the_probability_of_superiority_by_hand() -> None:
    # Of 6 x 5 pairs: 7 beats 1..5 (5); 3 beats 1, 2 and ties 3 (2.5); four zeros beat nothing: 7.5 of 30.
    change = change_between([rows_of([1, 2, 3, 4, 5])], [rows_of([7, 3, 0, 0, 0, 0])], "median", seed=0)
    assert change.superiority.value == 7.5 / 30
    assert change.superiority.low <= 0.25 <= change.superiority.high


def test_the_interval_of_superiority_is_that_of_resampled_batches_written_out() -> None:
    rng = np.random.default_rng(4)
    below, above = rng.normal(0, 1, 30), rng.normal(0.5, 1, 25).round(1)
    change = change_between([rows_of(below.round(1))], [rows_of(above)], "median", seed=9)
    again = np.random.default_rng(9)
    sides = [LaunchValues(rows_of(values)) for values in (below.round(1), above)]
    draws = [side.draw(again) for side in sides]
    found = []
    for counts in zip(*draws, strict=True):
        one, two = (
            np.concatenate([np.tile(batch, n) for batch, n in zip(side.batches, drawn, strict=True)])
            for side, drawn in zip(sides, counts, strict=True)
        )
        found.append(((two[:, None] > one).mean() + (two[:, None] >= one).mean()) / 2)
    low, high = np.quantile(found, (0.025, 0.975))
    assert (change.superiority.low, change.superiority.high) == (pytest.approx(low), pytest.approx(high))


@settings(max_examples=50, deadline=None)
@given(
    rows=st.lists(st.lists(st.floats(0.1, 100), min_size=1, max_size=4), min_size=5, max_size=23),
    statistic=st.sampled_from(["median", "mean", "p90", "p99"]),
    seed=st.integers(0, 99),
)
def test_a_resample_has_the_statistic_of_its_values_written_out(
    rows: list[list[float]], statistic: str, seed: int
) -> None:
    cut = LaunchValues(Rows.of([np.array(row) for row in rows]))
    assert cut.levels.tolist() == [np.median(row) for row in rows]
    drawn = cut.draw(np.random.default_rng(seed))[:20]
    quick = cut.replicate(statistic, drawn)
    share = {"median": 50, "p90": 90, "p99": 99}
    for counts, value in zip(drawn, quick, strict=True):
        whole = np.concatenate([np.tile(batch, n) for batch, n in zip(cut.batches, counts, strict=True)])
        slow = whole.mean() if statistic == "mean" else np.percentile(whole, share[statistic])
        assert value == pytest.approx(slow)


@pytest.mark.parametrize(
    ("n", "statistic", "testable"),
    [
        (4, "median", False),
        (5, "median", True),
        (49, "p90", False),
        (50, "p90", True),
        (499, "p99", False),
        (500, "p99", True),
    ],
)
def test_too_few_values_have_no_interval_and_no_p(n: int, statistic: str, testable: bool) -> None:
    rows = rows_of(np.arange(1, n + 1))
    change = change_between([rows], [rows], statistic, seed=0)
    assert (change.p is not None) == testable
    assert (change.bounds is not None) == testable
    assert change.relative == 0


def test_what_does_not_vary_is_certain() -> None:
    same = change_between([rows_of([2] * 9)], [rows_of([2] * 9)], "median", seed=0)
    more = change_between([rows_of([2] * 9)], [rows_of([3] * 9)], "median", seed=0)
    assert same.noise == more.noise == Noise(0.0, math.inf)
    assert (same.p, same.bounds) == (1.0, (0.0, 0.0))
    assert (more.p, more.bounds) == (0.0, (pytest.approx(0.5), pytest.approx(0.5)))


def test_a_computed_value_needs_no_repeats() -> None:
    change = change_between([rows_of([4.0])], [rows_of([5.0])], "median", seed=0, exact=True)
    assert (change.p, change.relative) == (0.0, 0.25)


def test_something_out_of_nothing_has_no_size() -> None:
    change = change_between([rows_of([0.0] * 20)], [rows_of([0.0, 1.0] * 10)], "mean", seed=0)
    assert (change.relative, change.bounds, change.ratio.value) == (None, None, None)
    assert change.difference.value == 0.5
    assert change.p < 0.01
    slow = change_between([rows_of([0.0] * 20)], [rows_of([0.0] * 10 + [1.0] * 10)], "mean", seed=0)
    assert slow.noise is None  # no share of nothing


@pytest.mark.parametrize(
    ("baseline", "other", "bounds"), [(-10.0, -5.0, (0.5, 0.5)), (0.0, 0.0, (0.0, 0.0)), (0.0, 5.0, None)]
)
def test_bounds_without_a_ratio_are_those_of_the_difference(
    baseline: float, other: float, bounds: tuple[float, float] | None
) -> None:
    change = change_between([rows_of([baseline])], [rows_of([other])], "median", seed=0, exact=True)
    assert change.bounds == bounds


@pytest.mark.parametrize(("rows", "dependent"), [(59, True), (61, False)])
def test_rows_remember_about_one_plus_r_over_one_minus_r_rows(rows: int, dependent: bool) -> None:
    assert RowCorrelation(r=0.5, n=rows, k=20).dependent is dependent  # 3 rows, and batches of n / k


@pytest.mark.parametrize(("r", "dependent"), [(0.63, False), (0.64, True)])
def test_neighbours_that_are_alike_by_chance_are_not_dependent(r: float, dependent: bool) -> None:
    assert RowCorrelation(r, n=10, k=5).dependent is dependent  # 2 / sqrt(10) = .632


@pytest.mark.parametrize("values", [[], [5.0], [3.0, 1, 2], [2.0, 2, 2], [1.0, -math.inf, 1, 7, -0.0, 0.0, 7, 7]])
def test_equal_values_share_their_mean_rank(values: list[float]) -> None:
    assert ranks_of(np.array(values)).tolist() == stats.rankdata(values).tolist()


def test_a_series_remembers_from_nothing_to_almost_all() -> None:
    assert RowCorrelation.of(np.arange(1000.0)) == RowCorrelation(0.95, 1000, 10)
    assert RowCorrelation.of(np.array([1.0, 9, 1, 9, 1, 9, 1])) == RowCorrelation(0.0, 7, 7)
    assert RowCorrelation.of(np.ones(12)) == RowCorrelation(0.0, 12, 10)
    assert RowCorrelation(0.3, 1, 1).hidden == 1.0


def test_one_launch_beside_several_tells_a_superiority_without_an_interval() -> None:
    one, three = [rows_of(range(1, 11))], [rows_of(range(2, 12)) for _ in range(3)]
    for sides in ((one, three), (three, one)):
        change = change_between(*sides, "median", seed=0)
        assert change.p is not None
        assert change.superiority.value == pytest.approx(0.595 if sides[0] is one else 0.405)
        assert change.superiority.low is None


@pytest.mark.parametrize("last", [6, 600])
def test_memory_is_the_correlation_of_neighbouring_ranks(last: float) -> None:
    assert RowCorrelation.of(np.array([1.0, 2, 3, 4, 5, last])).r == pytest.approx(8.75 / 17.5)  # ranks less 3.5


@pytest.mark.parametrize("k", [2, 20])
@pytest.mark.parametrize("r", [0.0, 0.3, 0.8])
def test_what_batches_hide_of_the_variance_is_that_of_the_means_of_a_series_of_order_one(r: float, k: int) -> None:
    def variance(m: int) -> float:
        return float(np.mean(r ** np.abs(np.subtract.outer(np.arange(m), np.arange(m)))))

    between = (variance(120 // k) - variance(120)) / (k - 1)  # of the means of k batches, around the whole mean
    assert RowCorrelation(r, 120, k).hidden == pytest.approx(variance(120) / between)


def test_a_launch_that_remembers_longer_than_a_batch_is_told() -> None:
    rng = np.random.default_rng(5)
    calm, slow = (rows_of(launch(rng, 100, correlation)) for correlation in (0.2, 0.97))
    assert not change_between([calm], [calm], "median", seed=0).dependent
    assert change_between([calm], [slow], "median", seed=0).dependent


def test_holm_by_hand() -> None:
    # .01 x 4, .02 x 3, .04 x 2, then .03 x 2 raised to what came before it
    assert holm([0.04, 0.01, None, 0.02, 0.9]) == [
        pytest.approx(0.08),
        pytest.approx(0.04),
        None,
        pytest.approx(0.06),
        0.9,
    ]
    assert holm([0.01, 0.015, 0.02]) == [pytest.approx(0.03)] * 3
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


@pytest.mark.parametrize(("factor", "least", "most"), [(1.0, 0.0, 0.06), (1.5, 0.9, 1.0)])
def test_ranks_tell_a_change_from_none_whatever_the_scale(factor: float, least: float, most: float) -> None:
    rng, found = np.random.default_rng(8), []
    for _ in range(REPEATS):
        before, after = (rng.lognormal(0, 0.4, n) for n in (200, 80))
        change = change_of_ranks(rows_of(before), rows_of(after * factor))
        assert change == change_of_ranks(rows_of(before**3), rows_of((after * factor) ** 3))
        found.append(change.p is not None and change.p < 0.01)
    assert least <= np.mean(found) <= most
