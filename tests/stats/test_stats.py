import json
import math
from dataclasses import asdict

import numpy as np
import pytest

from s2a_bench.stats import Ratio, Summary, ratio_of_medians, summarise


def test_a_summary_by_hand() -> None:
    # 1..5: mean 3, squares of the distances 4+1+0+1+4 = 10, sd = sqrt(10/4);
    # rank of p90 = .9 * 4 = 3.6 -> 4.6; of p99 = .99 * 4 = 3.96 -> 4.96
    summary = summarise([5, 1, 4, 2, 3])
    assert (summary.n, summary.mean, summary.median) == (5, 3.0, 3.0)
    assert summary.sd == pytest.approx(math.sqrt(2.5))
    assert summary.p90 == pytest.approx(4.6)
    assert summary.p99 == pytest.approx(4.96)


def test_a_single_value_has_no_spread() -> None:
    assert summarise([7.0]) == Summary(1, 7.0, None, 7.0, 7.0, 7.0)


def test_no_values_have_no_summary() -> None:
    with pytest.raises(ValueError, match="no values"):
        summarise([])


def test_the_ratio_is_that_of_the_medians() -> None:
    ratio = ratio_of_medians([2, 4, 60], [1, 2, 3], seed=1)
    assert ratio.value == 2.0


def test_the_interval_covers_a_known_ratio_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    covered = 0
    for trial in range(100):
        above, below = rng.lognormal(math.log(6), 0.2, 50), rng.lognormal(0, 0.2, 50)
        ratio = ratio_of_medians(above, below, seed=trial, resamples=500)
        assert ratio.low is not None
        assert ratio.high is not None
        covered += ratio.low <= 6 <= ratio.high
    assert 88 <= covered <= 100


def test_pairing_cancels_what_slows_both_cells_at_once() -> None:
    load = np.random.default_rng(3).lognormal(0, 0.5, 60)
    paired = ratio_of_medians(3 * load, load, seed=1)
    assert paired.low == pytest.approx(3)
    assert paired.high == pytest.approx(3)
    unpaired = ratio_of_medians(3 * load, load[:-1], seed=1)
    assert unpaired.low is not None
    assert unpaired.high is not None
    assert unpaired.high - unpaired.low > 0.3


def test_whole_blocks_are_resampled() -> None:
    # Two kinds of blocks whose values do not differ inside: ten samples a block add no certainty.
    blocks = np.repeat([[1.0], [3.0]] * 10, 10, axis=1)
    wide = ratio_of_medians(blocks, np.ones_like(blocks), seed=1)
    assert (wide.value, wide.low, wide.high) == (2.0, 1.0, 3.0)
    flat = ratio_of_medians(blocks.ravel(), np.ones(blocks.size), seed=1)
    same = ratio_of_medians(blocks[:, 0], np.ones(20), seed=1)
    assert flat.value == same.value == 2.0
    assert (same.low, same.high) == (wide.low, wide.high)


def test_the_same_seed_gives_the_same_interval() -> None:
    values = np.random.default_rng(1).lognormal(0, 1, 30)
    assert ratio_of_medians(values, values[::-1], seed=5) == ratio_of_medians(values, values[::-1], seed=5)
    assert ratio_of_medians(values, values[::-1], seed=5) != ratio_of_medians(values, values[::-1], seed=6)


def test_a_wider_confidence_gives_a_wider_interval() -> None:
    values = np.random.default_rng(1).lognormal(0, 1, 30)
    narrow = ratio_of_medians(values, np.ones(30), seed=5, confidence=0.5)
    wide = ratio_of_medians(values, np.ones(30), seed=5, confidence=0.99)
    assert wide.low < narrow.low < narrow.value < narrow.high < wide.high


@pytest.mark.parametrize(
    ("above", "below", "expected"),
    [
        ([], [], Ratio(None, None, None)),
        ([1.0], [], Ratio(None, None, None)),
        ([4.0], [2.0], Ratio(2.0, None, None)),
        ([4.0, 6.0], [2.0], Ratio(2.5, None, None)),
        ([1.0, 2.0], [0.0, 0.0], Ratio(None, None, None)),
        ([5.0, 5.0, 5.0], [2.0, 2.0, 2.0], Ratio(2.5, 2.5, 2.5)),
        ([1.0, math.nan], [1.0, 1.0], Ratio(None, None, None)),
    ],
)
def test_what_allows_no_interval_has_none_and_is_strict_json(
    above: list[float], below: list[float], expected: Ratio
) -> None:
    ratio = ratio_of_medians(above, below, seed=1)
    assert ratio == expected
    json.dumps(asdict(ratio), allow_nan=False)


def test_zeros_among_the_denominators_leave_no_bounds_rather_than_infinity() -> None:
    ratio = ratio_of_medians([1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0], seed=1)
    assert ratio.value == 2.0
    assert ratio.high is None
    json.dumps(asdict(ratio), allow_nan=False)
