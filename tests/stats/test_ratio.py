"""The ratio of two cells of one launch: pairing by block, and how often the interval holds the truth."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from s2a_bench.stats import Ratio
from s2a_bench.stats.batches import Blocks
from s2a_bench.stats.change import ratio_of_launches

Floats: TypeAlias = NDArray[np.float64]


def blocks_of(values: Sequence[float] | Floats) -> Blocks:
    return Blocks(np.asarray(values, dtype=np.float64), np.arange(len(values)))


def ratio(above: Sequence[float] | Floats, below: Sequence[float] | Floats, seed: int = 1, **of: Any) -> Ratio:
    return ratio_of_launches({0: blocks_of(above)}, {0: blocks_of(below)}, seed, **of)


def remembering(rng: np.random.Generator, n: int, correlation: float) -> Floats:
    """Draw a series of standard deviation 1 whose neighbours are alike (AR(1))."""
    noise = rng.standard_normal(n + 300) * math.sqrt(1 - correlation**2)
    return np.asarray(lfilter([1], [1, -correlation], noise)[300:])


def width(found: Ratio) -> float:
    return found.high - found.low


def test_the_ratio_is_that_of_the_medians() -> None:
    assert ratio([2, 4, 60], [1, 2, 3]) == Ratio(2.0, None, None, launches=1)
    assert ratio([2, 4, 60], [1, 2, 3], statistic="mean") == Ratio(11.0, None, None)


@pytest.mark.parametrize(
    ("n", "correlation", "shared", "least"),
    [
        (10, 0.0, 0.0, 183),  # of Binomial(200, 0.95), below 183 are 1 in 100
        (20, 0.4, 0.0, 174),  # too short to tell how alike neighbours are: 9 in 10
        (50, 0.4, 0.8, 183),
        (200, 0.8, 0.8, 183),
    ],
)
def test_the_interval_covers_a_known_ratio_about_as_often_as_it_says(
    n: int, correlation: float, shared: float, least: int
) -> None:
    """``shared`` is how much of their ups and downs two cells have from the machine, which slows both."""
    rng = np.random.default_rng(7)
    covered = 0
    for trial in range(200):
        load = shared * remembering(rng, n, correlation)
        own = [math.sqrt(1 - shared**2) * remembering(rng, n, correlation) for _ in range(2)]
        found = ratio(6 * np.exp(0.15 * (load + own[0])), np.exp(0.15 * (load + own[1])), seed=trial)
        covered += found.low <= 6 <= found.high
    assert covered >= least


def test_pairing_cancels_what_slows_both_cells_at_once() -> None:
    load = np.random.default_rng(3).lognormal(0, 0.5, 60)
    assert width(ratio(3 * load, load)) < 1e-9
    assert width(ratio(3 * load, load[:-1])) > 0.3


def test_samples_of_one_block_stay_together() -> None:
    # Values do not differ inside of blocks: ten samples a block add no certainty.
    levels = [1.0, 3.0, 2.0, 1.5, 2.5, 1.2] * 4
    single = ratio(levels, np.ones(24))
    tenfold = Blocks(np.repeat(levels, 10), np.repeat(np.arange(24), 10))
    many = ratio_of_launches({0: tenfold}, {0: blocks_of(np.ones(24))}, 1)
    assert width(many) == pytest.approx(width(single), rel=0.1)


@pytest.mark.parametrize(
    ("above", "below", "expected"),
    [
        ([4.0], [2.0], Ratio(2.0, None, None)),
        ([4.0, 6.0], [2.0], Ratio(2.5, None, None)),
        ([1.0] * 5, [0.0] * 5, Ratio(None, None, None)),
        ([5.0] * 4, [2.0] * 4, Ratio(2.5, None, None)),
        ([5.0] * 5, [2.0] * 5, Ratio(2.5, pytest.approx(2.5), pytest.approx(2.5))),  # type: ignore[arg-type]
        ([1.0] * 6, [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], Ratio(2.0, None, None)),
    ],
)
def test_what_allows_no_interval_has_none_and_is_strict_json(
    above: list[float], below: list[float], expected: Ratio
) -> None:
    found = ratio(above, below)
    assert found == expected
    json.dumps(asdict(found), allow_nan=False)


def test_a_cell_without_values_has_no_ratio() -> None:
    assert ratio([], [1.0]) is None
    assert ratio([1.0], []) is None


def launches(rng: np.random.Generator, n: int, spread: float, runs: int = 15) -> list[dict[int, Blocks]]:
    """Draw two cells whose ratio, 6, differs from launch to launch by ``spread``."""
    cells: list[dict[int, Blocks]] = [{}, {}]
    for launch in range(n):
        load = remembering(rng, runs, 0.4)
        shift = spread * rng.standard_normal()
        cells[0][launch] = blocks_of(6 * np.exp(shift + 0.15 * (load + rng.standard_normal(runs))))
        cells[1][launch] = blocks_of(np.exp(0.15 * (load + rng.standard_normal(runs))))
    return cells


@pytest.mark.parametrize("spread", [0.04, 0.13])
def test_over_launches_the_interval_covers_what_one_launch_cannot_know(spread: float) -> None:
    rng = np.random.default_rng(5)
    covered = alone = 0
    for seed in range(400):
        above, below = launches(rng, 5, spread)
        found = ratio_of_launches(above, below, seed)
        covered += found.low <= 6 <= found.high
        if seed < 100:
            above, below = launches(rng, 1, spread, runs=75)  # as many requests, all in one launch
            one = ratio_of_launches(above, below, seed)
            alone += one.low <= 6 <= one.high
    assert 366 <= covered <= 393  # 99 of 100 of Binomial(400, 0.95)
    assert alone <= {0.04: 94, 0.13: 65}[spread]


def test_over_launches_the_ratio_is_the_geometric_mean_with_students_interval() -> None:
    above, below = ({0: blocks_of([2.0]), 1: blocks_of([8.0])}, {0: blocks_of([1.0]), 1: blocks_of([1.0])})
    found = ratio_of_launches(above, below, 0)
    sd = math.log(4) / math.sqrt(2)
    reach = 12.7062 * sd / math.sqrt(2)
    assert found == Ratio(
        pytest.approx(4.0),  # type: ignore[arg-type]
        pytest.approx(4 * math.exp(-reach), rel=1e-4),  # type: ignore[arg-type]
        pytest.approx(4 * math.exp(reach), rel=1e-4),  # type: ignore[arg-type]
        2,
        pytest.approx(sd),
    )


def test_over_launches_means_are_divided_where_means_are_asked_for() -> None:
    above, below = (
        {n: blocks_of([1.0, 1.0, 10.0]) for n in range(2)},
        {n: blocks_of([1.0, 1.0, 4.0]) for n in range(2)},
    )
    found = ratio_of_launches(above, below, 0, "mean")
    assert found == Ratio(pytest.approx(2.0), pytest.approx(2.0), pytest.approx(2.0), 2, 0.0)  # type: ignore[arg-type]
    assert ratio_of_launches(above, {n: blocks_of([0.0]) for n in range(2)}, 0) == Ratio(None, None, None, 2)


def test_a_launch_in_which_a_cell_has_nothing_does_not_count() -> None:
    above, below = {0: blocks_of([2.0]), 1: blocks_of([4.0])}, {1: blocks_of([2.0])}
    assert ratio_of_launches(above, below, 0) == Ratio(2.0, None, None)
    assert ratio_of_launches({0: blocks_of([2.0])}, below, 0) is None
    assert ratio_of_launches(above, {0: blocks_of([1.0]), 1: blocks_of([0.0])}, 0) == Ratio(6.0, None, None, 2)
