"""The online rule: its formulas by hand, its steps against its arrays, and what it must never do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.policy import Plans, PlanShape, Start, Timing, stepping
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.stream_to_act import EarlyStart, MeanStart, OnlineStepper, StreamToAct
from s2a_bench.testing.policy import EXACT, draw
from tests.conftest import examples

SHAPE = PlanShape(4, 2, Timing(1.0, 0.8, 1.5), expected_cv=0.2)
PRIOR = GapPrior(0.5, 0.1, 0.2)
KINDS = st.sampled_from([StreamToAct, MeanStart])
VARIANTS = st.one_of(
    st.builds(partial, KINDS, detect=st.booleans()),
    st.builds(
        partial,
        st.just(EarlyStart),
        detect=st.booleans(),
        spend=st.sampled_from([0.0, 0.3, 1.0]),
        within=st.sampled_from([0.0, 0.5, 1.0, math.inf]),
        start_caution=st.sampled_from([0.1, 0.7, 1.0]),
    ),
)
"""What makes a policy of a prior and a caution."""
PRIORS = st.builds(GapPrior, st.floats(0.02, 2), st.floats(0.01, 3), st.floats(0.01, 2))
CAUTIONS = st.one_of(st.floats(0, 6), st.just(math.inf))


def slowing(plans: Plans, times: float) -> Plans:
    """Make all gaps so many times as long from the middle of the plan on."""
    assert plans.token_s is not None
    count, tokens = len(plans.arrival_s), len(plans.token_s)
    gaps = np.diff(plans.token_s, axis=0, prepend=0.0)
    gaps[tokens // 2 :] *= times
    token_s = np.cumsum(gaps, axis=0)
    return replace(plans, token_s=token_s, arrival_s=token_s[tokens // count - 1 :: tokens // count])


def stepper(caution: float = 2.0, *, prior: GapPrior = PRIOR) -> OnlineStepper:
    """Make a stepper that has seen two tokens, at 1.0 and 1.6, and the first of four skills with them."""
    made = StreamToAct(prior, caution).stepper(SHAPE)
    assert isinstance(made, OnlineStepper)
    made.token(1.0)
    made.token(1.6)
    made.fragment(1.6, Timing(1.2, 1.0, 1.5))
    return made


def forecast(tokens: float, unknown: int, caution: float, duration_s: float) -> float:
    """Write down the forecast after those two tokens, in s from the second: one gap of 0.6 s has been seen."""
    sigma, tau = 0.2 * 0.5, 0.1 * 0.5
    variance = 1 / (1 / tau**2 + 1 / sigma**2)
    mean = variance * (0.5 / tau**2 + 0.6 / sigma**2)
    scale = (mean / 0.5) ** 2  # spreads are relative to the mean
    noise = scale * (tokens * sigma**2 + tokens**2 * variance) + unknown * (0.2 * duration_s) ** 2
    return tokens * mean + caution * math.sqrt(noise)


@pytest.mark.parametrize("caution", [0.0, 2.33])
def test_the_mean_rule_never_stretches(caution: float) -> None:
    made = MeanStart(PRIOR, caution).stepper(PlanShape(2, 2, Timing(1.0, 0.8, 1.5)))
    made.token(1.0)
    made.fragment(1.0, Timing(1.2, 1.0, 1.5))
    made.fragment(2.0, Timing(1.0, 0.8, 1.5))
    assert made.decide(2.0) == Start(1.2, 1.2)
    assert made.decide(9.0) == Start(1.0, 1.0)  # late, and still not compressed


@pytest.mark.parametrize("caution", [0.0, 1.0, 3.0])
def test_the_start_is_when_mean_meets_nominal_and_caution_meets_stretched(caution: float) -> None:
    demands = [
        1.6 + forecast(2 + 2 * unknown, unknown, lam, known) - (first + unknown * known)
        for unknown in range(3)
        for lam, first, known in ((0.0, 1.2, 1.0), (caution, 1.5, 1.5))
    ]
    answer = stepper(caution).decide(1.6)
    if max(demands) <= 1.6:
        assert isinstance(answer, Start)
    else:
        assert answer == pytest.approx(max(demands))
        assert isinstance(stepper(caution).decide(max(demands) + 1e-12), Start)


def test_the_caution_is_what_was_asked_for_else_the_99_per_cent_quantile() -> None:
    cautions = [StreamToAct(PRIOR, caution).stepper(SHAPE).caution for caution in (None, 0.0, 1.5)]  # type: ignore[attr-defined]
    assert cautions == [2.33, 0.0, 1.5]
    assert MeanStart().caution == 0.0


@pytest.mark.parametrize("caution", [0.0, 1.0])
@pytest.mark.parametrize(
    ("spend", "within", "start_caution", "used"),
    [(0.0, math.inf, 1.0, 0.0), (0.5, math.inf, 1.0, 0.5), (0.5, 0.31, 0.5, 0.5), (1.0, 0.2, 2.0, 0.0)],
)
def test_an_early_start_spends_a_share_of_the_stretch_where_it_comes_soon_enough(
    spend: float, within: float, start_caution: float, used: float, caution: float
) -> None:
    robot = EarlyStart(PRIOR, caution, spend=spend, within=within, start_caution=start_caution).stepper(
        PlanShape(4, 3, Timing(1.6, 1.2, 2.4))  # whole: 1.2 + 3 x 1.6 = 6 s
    )
    robot.token(1.0)
    robot.token(1.6)
    robot.fragment(1.6, Timing(1.2, 1.0, 1.5))
    demands = [
        1.6 + forecast(3 + 3 * unknown, unknown, lam, each) - (first + unknown * each)
        for unknown in range(3)
        for lam, first, each in ((0.0, 1.2 + used * 0.3, 1.6 + used * 0.8), (start_caution * caution, 1.5, 2.4))
    ]
    assert robot.decide(1.6) == pytest.approx(max(demands))


@pytest.mark.parametrize("caution", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("most_s", [0.9, 1.0, 1.05, 1.07, 1.1, 1.2, 1.4, 1.7])
def test_a_robot_holds_where_not_even_a_favourable_forecast_can_be_met(most_s: float, caution: float) -> None:
    robot = StreamToAct(PRIOR, caution, detect=True).stepper(PlanShape(2, 3, Timing(1.0, 0.8, 1.5)))
    assert isinstance(robot, OnlineStepper)
    robot.token(1.0)
    robot.token(1.6)
    robot.fragment(1.6, Timing(0.8, 0.7, most_s))
    robot.due_s = 1.6  # it has begun
    favourable = 1.6 + forecast(3, 0, -2.0, 0.0) - most_s
    cautious = 1.6 + forecast(3, 0, caution, 0.0) - most_s
    answer = robot.decide(1.6)
    if favourable <= 1.6 or cautious <= 1.6:
        assert isinstance(answer, Start)
    elif forecast(2, 0, caution, 0.0) > most_s:
        assert answer == math.inf  # only the next token can tell
    else:
        assert answer == pytest.approx(cautious)


@pytest.mark.parametrize("now_s", [1.7, 2.0, 2.2, 2.4])
def test_a_skill_is_stretched_to_the_worst_forecast_which_a_late_token_pushes(now_s: float) -> None:
    robot = stepper(1.0)
    robot.due_s = now_s  # it has begun, and is not late
    ratios = []
    for unknown in range(3):
        arrival = max(
            1.6 + forecast(2 + 2 * unknown, unknown, 1.0, 1.0), now_s + forecast(1 + 2 * unknown, unknown, 1.0, 1.0)
        )
        ratios.append((arrival - now_s) / (1.2 + unknown))
    answer = robot.decide(now_s)
    assert isinstance(answer, Start)
    assert answer.duration_s == pytest.approx(1.2 * min(max(*ratios, 1.0), 1.25))
    assert answer.latest_s == 1.5


def test_an_overdue_token_puts_the_start_off_until_it_comes() -> None:
    slow = GapPrior(2.0, 0.001, 0.01)
    robot = stepper(0.0, prior=slow)
    assert robot.decide(1.6) == math.inf  # 6 tokens of 2 s for 3.2 s of work: only another token can tell
    robot.token(3.6)
    robot.token(5.6)
    robot.fragment(5.6, Timing(4.5, 4.0, 5.0))
    at_s = robot.decide(5.6)
    assert at_s == pytest.approx(5.6 + 4 * 2.0 - (1.2 + 4.5 + 1.0), abs=0.1)  # before the next token is due
    robot.token(at_s - 0.1)
    earlier = robot.decide(at_s - 0.1)
    assert isinstance(earlier, Start)  # it came early, and one less is missing


def test_lateness_is_recovered_down_to_the_least_duration_and_not_beyond_schedule() -> None:
    shape = replace(SHAPE, n_skills=3)
    robot = StreamToAct(PRIOR).stepper(shape)
    for at_s in (0.5, 1.0):
        robot.token(at_s)
        robot.fragment(at_s, Timing(1.0, 0.8, 1.5))
    robot.token(1.5)
    robot.fragment(1.5, Timing(1.0, 0.8, 1.5))
    robot.end(1.5)
    assert robot.decide(1.5) == Start(1.0, 1.5)
    late = robot.decide(2.6)  # .1 s late
    assert isinstance(late, Start)
    assert late.duration_s == pytest.approx(0.9)
    later = robot.decide(4.5)  # 1 s late
    assert isinstance(later, Start)
    assert later.duration_s == pytest.approx(0.8)


@settings(max_examples=examples(150))
@given(
    kind=VARIANTS,
    prior=PRIORS,
    caution=CAUTIONS,
    seed=st.integers(0, 2**32 - 1),
    n_skills=st.integers(1, 9),
    tokens=st.integers(1, 5),
    rho=st.floats(0.2, 4.0),
    more=st.integers(0, 4),
    believed_tokens=st.floats(0.5, 7.0),
    expected_cv=st.floats(0, 0.5),
    parsing_s=st.floats(0, 0.4),
    trailing=st.integers(0, 3),
    slower=st.sampled_from([1.0, 2.0, 5.0]),
)
def test_steps_and_arrays_agree_whatever_is_believed_and_however_fragments_lag(
    kind: Callable[[GapPrior, float], StreamToAct],
    prior: GapPrior,
    caution: float,
    seed: int,
    n_skills: int,
    tokens: int,
    rho: float,
    more: int,
    believed_tokens: float,
    expected_cv: float,
    parsing_s: float,
    trailing: int,
    slower: float,
) -> None:
    plans = slowing(draw(seed, n_skills, tokens, rho, 3), slower)
    assert plans.token_s is not None
    after = plans.token_s[-1] + np.cumsum(np.full((trailing, 3), 0.21), axis=0)
    plans = replace(
        plans,
        token_s=np.vstack([plans.token_s, after]),
        # Fragments are parsed later than their last token, between tokens and past them.
        arrival_s=plans.arrival_s + parsing_s * np.arange(1, n_skills + 1)[:, np.newaxis],
        shape=PlanShape(n_skills + more, believed_tokens, Timing(1.1, 0.9, 1.4), expected_cv),
    )
    schedule = kind(prior, caution).schedule(plans)
    stepped = stepping.schedule(kind(prior, caution), plans)
    np.testing.assert_allclose(stepped.start_s, schedule.start_s, rtol=0, atol=EXACT)
    np.testing.assert_allclose(stepped.duration_s, schedule.duration_s, rtol=0, atol=EXACT)


def test_infinite_caution_waits_for_the_whole_plan_and_never_stalls() -> None:
    plans = draw(8, 6, 3, 1.4, 50, gap_cv=1.0)
    schedule = StreamToAct(PRIOR, math.inf).schedule(plans)
    np.testing.assert_array_equal(schedule.start_s[0], plans.arrival_s[-1])
    assert (stalls(schedule) <= EXACT).all()


def test_plans_without_tokens_or_shape_are_refused() -> None:
    plans = draw(1, 3, 2, 1.0, 1)
    for missing in ("token_s", "shape"):
        with pytest.raises(ValueError, match="need token_s and shape"):
            StreamToAct(PRIOR).schedule(replace(plans, **{missing: None}))
