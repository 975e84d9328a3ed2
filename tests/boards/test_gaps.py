"""Every family keeps its mean, has the shape it promises, and survives the way through a profile's table."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.boards.gaps import (
    FAMILIES,
    Bursty,
    Constant,
    Gaps,
    Lognormal,
    Markov,
    Quantiles,
    Recorded,
    from_table,
    to_table,
)
from s2a_bench.errors import UsageError

EXAMPLES: tuple[Gaps, ...] = (
    Constant(0.2),
    Lognormal(0.2, 0.2),
    Markov(0.2, 0.1, 0.02, 10, 4),
    Bursty(0.2, 0.1, 4, 0.05),
    Quantiles(0.2, (0, 0.5, 0.9, 1), (1, 1.1, 2, 9)),
    Recorded(0.2, (1, 1, 4, 2, 1.5)),
)
MEANS = st.floats(1e-4, 10)
PARTS = st.floats(0, 1)
SHARES = st.one_of(st.just(0.0), st.floats(0.005, 0.5))
"""None, or so many that a sample of 48,000 has some: one without pauses says nothing of their mean."""
GAPS: st.SearchStrategy[Gaps] = st.one_of(
    st.builds(Constant, MEANS),
    st.builds(Lognormal, MEANS, PARTS),
    st.builds(Markov, MEANS, PARTS, SHARES, st.floats(1, 20), st.floats(2, 5)),
    st.builds(Bursty, MEANS, PARTS, st.integers(1, 9), PARTS),
    st.builds(
        lambda mean, inner, steps: Quantiles(
            mean, (0.0, *sorted(inner), 1.0), tuple(np.cumsum(steps[: len(inner) + 2]).tolist())
        ),
        MEANS,
        st.sets(st.floats(0.01, 0.99), min_size=1, max_size=5),
        st.lists(st.floats(0.01, 3), min_size=7, max_size=7),
    ),
    st.builds(Recorded, MEANS, st.lists(st.floats(0.01, 9), min_size=1, max_size=50).map(tuple)),
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_every_family_is_an_example_here() -> None:
    assert [type(gaps) for gaps in EXAMPLES] == list(FAMILIES.values())


@given(GAPS, st.integers(0, 2**31))
def test_the_mean_is_kept_the_shape_is_as_asked_and_no_gap_is_negative(gaps: Gaps, seed: int) -> None:
    drawn = gaps.sample(rng(seed), 12, 4000)
    assert drawn.shape == (12, 4000)
    assert drawn.dtype == np.float64
    assert drawn.min() >= 0
    columns = drawn.mean(axis=0)  # independent of each other, whatever is within
    error = 6 * columns.std() / math.sqrt(columns.size) + 1e-9 * gaps.mean_s
    assert abs(columns.mean() - gaps.mean_s) <= error


@given(GAPS)
def test_a_family_survives_the_way_through_a_table(gaps: Gaps) -> None:
    assert from_table(to_table(gaps), gaps.mean_s) == gaps


def test_lognormal_gaps_have_their_coefficient_of_variation() -> None:
    drawn = Lognormal(0.3, 0.5).sample(rng(), 100, 5000)
    assert drawn.std() / drawn.mean() == pytest.approx(0.5, rel=0.02)


def test_pauses_are_their_share_from_the_first_token_on_and_last_as_long_as_said() -> None:
    gaps = Markov(0.2, 0.0, pause_share=0.1, pause_ratio=5, pause_tokens=4)
    drawn = gaps.sample(rng(1), 400, 4000)
    pauses = drawn > 2 * gaps.normal_s
    assert set(np.unique(drawn.round(9))) == {round(gaps.normal_s, 9), round(5 * gaps.normal_s, 9)}
    for row in (0, 1, 399):
        assert pauses[row].mean() == pytest.approx(0.1, abs=0.02)
    ended = pauses[:-1] & ~pauses[1:]
    assert pauses[:-1].sum() / ended.sum() == pytest.approx(4, rel=0.05)
    assert gaps.normal_s * (1 + 0.1 * 4) == pytest.approx(0.2)


def test_pauses_of_least_length_come_independently() -> None:
    drawn = Markov(1, 0.0, 0.25, 9, 1 / 0.75).sample(rng(2), 2, 200_000) > 2
    assert (drawn[0] & drawn[1]).mean() == pytest.approx(0.25**2, rel=0.05)


def test_a_burst_is_one_long_gap_and_then_short_ones_from_any_place() -> None:
    drawn = Bursty(0.1, 0.0, 5, 0.1).sample(rng(3), 50, 300)
    assert set(np.unique(drawn.round(9))) == {0.01, 0.46}
    for column in drawn.T:
        runs = [(long, len(list(run))) for long, run in groupby(column > 0.1)]
        assert all(length == (1 if long else 4) for long, length in runs[1:-1])
    assert (drawn[0] > 0.1).mean() == pytest.approx(0.2, abs=0.08)
    np.testing.assert_allclose(drawn[:5].sum(axis=0), 0.5)


def test_quantiles_are_met() -> None:
    gaps = Quantiles(0.1, (0, 0.5, 0.9, 1), (1, 1.1, 2, 9))
    drawn = gaps.sample(rng(4), 100, 5000)
    np.testing.assert_allclose(np.quantile(drawn, (0.5, 0.9)), gaps.quantiles_s()[1:3], rtol=0.01)
    assert drawn.min() >= gaps.quantiles_s()[0]
    assert drawn.max() <= gaps.quantiles_s()[-1]


def test_a_recording_is_cut_at_random_places_and_wraps() -> None:
    trace = (1.0, 2.0, 3.0, 4.0)
    drawn = Recorded.of(trace).sample(rng(6), 6, 200)
    assert {tuple(column) for column in drawn.T} == {
        tuple(np.roll(np.tile(trace, 2), -start)[:6].tolist()) for start in range(4)
    }


@given(st.lists(st.floats(1e-6, 9), min_size=1, max_size=30), st.integers(0, 99), st.integers(0, 99))
def test_a_recording_in_order_is_exactly_what_was_recorded(trace: list[float], tokens: int, start: int) -> None:
    played = Recorded.of(tuple(trace)).in_order(tokens, start)
    assert played.tolist() == [trace[(start + place) % len(trace)] for place in range(tokens)]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "family: None is not one of constant, lognormal, markov"),
        ({"family": ["lognormal"]}, r"family: \['lognormal'\] is not one of"),
        ({"family": "normal"}, "family: 'normal' is not one of"),
        ({"family": "lognormal"}, "cv: is missing"),
        ({"family": "lognormal", "cv": 0.2, "sd": 1}, "sd: lognormal gaps have no such key; they have cv"),
        ({"family": "constant", "cv": 0}, "cv: constant gaps have no such key; they have none"),
        ({"family": "lognormal", "cv": "0.2"}, "cv: '0.2' should be a number"),
        ({"family": "lognormal", "cv": True}, "cv: True should be a number"),
        ({"family": "lognormal", "cv": -0.1}, "cv: -0.1 should be greater than or equal to 0"),
        ({"family": "lognormal", "cv": math.inf}, "cv: inf should be"),
        ({"family": "bursty", "cv": 0, "burst_tokens": 2.5, "within": 0}, "burst_tokens: 2.5 should be a whole number"),
        ({"family": "bursty", "cv": 0, "burst_tokens": 0, "within": 0}, "burst_tokens: 0 should be greater"),
        ({"family": "bursty", "cv": 0, "burst_tokens": 2, "within": 2}, "within: 2 should be less than or equal to 1"),
        (
            {"family": "markov", "cv": 0, "pause_share": 0.5, "pause_ratio": 2, "pause_tokens": 1},
            "pause_tokens: 1 should be 2 or more",
        ),
        ({"family": "quantiles", "levels": [0, 1], "values": 3}, "values: 3 should be a list"),
        ({"family": "quantiles", "levels": [0, 0.5], "values": [1, 2]}, "levels: should run from 0 to 1"),
        ({"family": "quantiles", "levels": [0, 0.5, 0.5, 1], "values": [1, 2, 3, 4]}, "levels: should increase"),
        ({"family": "quantiles", "levels": [0, 1], "values": [1]}, "values: 1 of them for 2 levels"),
        ({"family": "quantiles", "levels": [0, 1], "values": [2, 1]}, "values: should not decrease"),
        ({"family": "quantiles", "levels": [0, 1], "values": [-1, 1]}, "values: should be finite, none negative"),
        ({"family": "recorded", "trace": []}, "trace: should hold finite gaps"),
        ({"family": "recorded", "trace": [0.1, -0.1]}, "trace: should hold finite gaps"),
    ],
)
def test_a_table_that_is_wrong_names_its_key(table: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=f"^{message}"):
        from_table(table, 0.1)


@pytest.mark.parametrize("mean", [0, -1, math.nan, math.inf])
def test_a_mean_that_is_none_is_refused(mean: float) -> None:
    with pytest.raises(UsageError, match=r"^mean_s: .* should be "):
        from_table({"family": "lognormal", "cv": 0.2}, mean)
