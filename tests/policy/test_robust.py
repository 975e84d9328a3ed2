"""s2a-robust: no stalls within the declared bound, no earlier start that is as safe, waiting without a bound."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Timing, stepping
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.robust import RobustStart
from s2a_bench.policy.schedule import safe_start
from s2a_bench.testing.policy import EXACT, draw

BOUND = 1.3


def bounded(seed: int, n_skills: int, plans: int, share: float) -> Plans:
    """Make plans whose gaps are anything up to the bound, often the bound itself; skills last at least .6 s."""
    rng = np.random.default_rng(seed)
    gaps = np.where(rng.random((n_skills, plans)) < share, BOUND, rng.uniform(0, BOUND, (n_skills, plans)))
    arrival_s = np.cumsum(gaps, axis=0)
    nominal_s = rng.uniform(0.6, 2.0, (n_skills, plans))
    shape = PlanShape(n_skills, 1, Timing(1.0, 0.6, 2.5))
    return Plans(arrival_s, nominal_s, 0.8 * nominal_s, 1.5 * nominal_s, arrival_s, shape)


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n_skills=st.integers(1, 12), share=st.floats(0, 1))
def test_it_never_stalls_when_gaps_keep_the_bound(seed: int, n_skills: int, share: float) -> None:
    plans = bounded(seed, n_skills, 30, share)
    assert (stalls(RobustStart(BOUND).schedule(plans)) <= EXACT).all()


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_skills=st.integers(1, 8),
    more=st.integers(-1, 2),
    parsing_s=st.sampled_from([0.0, 0.3]),
    trailing_s=st.sampled_from([0.0, 0.7]),
)
def test_its_steps_and_arrays_agree_whatever_is_expected_and_however_fragments_lag(
    seed: int, n_skills: int, more: int, parsing_s: float, trailing_s: float
) -> None:
    plans = draw(seed, n_skills, 2, 1.2, 2)
    assert plans.token_s is not None
    plans = replace(
        plans,
        arrival_s=plans.arrival_s + parsing_s,
        token_s=np.vstack([plans.token_s, plans.token_s[-1] + trailing_s]),
        shape=PlanShape(n_skills + more, 2, Timing(1.0, 0.8, 1.5)),
    )
    policy = RobustStart(BOUND)
    stepped = stepping.schedule(policy, plans)
    np.testing.assert_allclose(stepped.start_s, policy.schedule(plans).start_s, rtol=0, atol=EXACT)
    np.testing.assert_allclose(stepped.duration_s, plans.nominal_s, rtol=0, atol=EXACT)


def test_no_earlier_start_is_safe_when_every_gap_is_the_bound() -> None:
    arrival_s = 0.7 + BOUND * np.arange(6.0)[:, np.newaxis]
    nominal_s = np.full((6, 1), 0.9)
    shape = PlanShape(6, 1, Timing(0.9, 0.9, 0.9))
    plans = Plans(arrival_s, nominal_s, nominal_s, nominal_s, arrival_s, shape)
    start_s = RobustStart(BOUND).schedule(plans).start_s[0]
    assert start_s == pytest.approx(safe_start(arrival_s, nominal_s))
    assert start_s == pytest.approx(0.7 + 5 * (BOUND - 0.9))


def test_without_a_bound_it_waits_for_the_whole_plan() -> None:
    plans = draw(3, 5, 2, 0.4, 10)
    np.testing.assert_array_equal(RobustStart().schedule(plans).start_s[0], plans.arrival_s[-1])


def test_a_gap_beyond_the_bound_may_stall() -> None:
    plans = bounded(1, 6, 1, 1.0)
    late = replace(plans, arrival_s=plans.arrival_s + np.array([0, 0, 0, 0, 0, 50.0])[:, np.newaxis])
    assert stalls(RobustStart(BOUND).schedule(late)).max() > 0


@pytest.mark.parametrize("bound_s", [0.0, -1.0, math.nan])
def test_what_is_no_bound_is_refused(bound_s: float) -> None:
    with pytest.raises(UsageError, match="gap bound"):
        RobustStart(bound_s)
