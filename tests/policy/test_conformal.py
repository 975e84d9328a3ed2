"""Calibrated caution keeps its promise, says when it cannot, and follows a machine that drifts."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal, stats

from s2a_bench.boards.gaps import Markov
from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, conformal
from s2a_bench.policy.conformal import (
    GRID,
    Guarantee,
    TrackedPolicy,
    Tracker,
    calibrate,
    choose,
    no_promise,
    promise,
    scores,
    stalled,
    take,
    upper_bound,
)
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.nominal import Naive
from s2a_bench.policy.stream_to_act import EarlyStart, StreamToAct
from s2a_bench.stats.seeds import generator
from studies.worlds import World

WORLD = World(4.8, 0.5, 2, 4, 0.25)
"""rho = 1.67: a start at the first skill stalls."""
BURSTS = Markov(1 / 4.8, 0.2, pause_share=0.02, pause_ratio=10.0, pause_tokens=3.0)


def fitted(plans: Plans) -> StreamToAct:
    assert plans.token_s is not None
    return StreamToAct(GapPrior.fit(plans.token_s))


def test_cautions_are_quarters_to_4_then_coarser_to_32() -> None:
    assert [*GRID[:17]] == [0.25 * quarter for quarter in range(17)]
    assert all(1.1 * less < more <= 1.5 * less for less, more in pairwise(GRID[16:]))
    assert GRID[-1] == 32


def test_a_gap_between_skills_that_is_longer_than_a_microsecond_is_a_stall() -> None:
    arrival_s = np.array([[0.0, 0.0], [1 + 0.5e-6, 1 + 2e-6]])
    column = np.ones((2, 1))
    assert stalled(Naive().schedule(Plans(arrival_s, column, column, column))).tolist() == [False, True]


def test_a_plan_s_score_is_the_least_caution_from_which_on_it_never_stalls() -> None:
    plans = replace(WORLD, gaps=BURSTS).draw(np.random.default_rng(1), 25)
    policy = fitted(plans)
    found = scores(policy, plans)
    for column in range(25):
        alone = take(plans, np.array([column]))
        least = math.inf
        for caution in reversed(GRID):
            if stalled(replace(policy, caution=caution).schedule(alone))[0]:
                break
            least = caution
        assert found[column] == least
    assert len(set(found.tolist())) >= 5


def test_a_plan_that_only_waiting_saves_scores_infinity() -> None:
    plans = WORLD.draw(np.random.default_rng(2), 3)
    assert plans.token_s is not None
    token_s = plans.token_s.copy()
    token_s[-1, 1] += 1000
    plans = replace(plans, token_s=token_s, arrival_s=token_s[1::2])
    assert scores(StreamToAct(GapPrior(1 / 4.8, 0.1, 0.2)), plans)[1] == math.inf


@pytest.mark.parametrize(
    ("guarantee", "count", "may_stall"),
    [
        *(("high-confidence", *each) for each in ((99, 0), (341, 0), (342, 0), (400, 0), (1000, 7), (4000, 39))),
        *(("expected", *each) for each in ((99, 0), (400, 3), (1000, 9), (4000, 39))),
    ],
)
def test_more_plans_allow_more_of_them_to_stall(guarantee: Guarantee, count: int, may_stall: int) -> None:
    known = choose(np.arange(count, dtype=float), 0.01, guarantee)
    assert (known.guarantee, known.stalled, known.caution) == (guarantee, may_stall, count - 1 - may_stall)
    assert known.expected_risk == (may_stall + 1) / (count + 1) <= 0.01
    if guarantee == "high-confidence":
        assert (count < 342) == (known.risk > 0.02)


def test_the_promises_hold_for_scores_of_any_distribution() -> None:
    rng = np.random.default_rng(6)
    risks = np.array([1 - choose(rng.random(400)).caution for _ in range(4000)])  # P(score > lambda), exactly
    error = risks.std() / 4000**0.5
    assert risks.mean() <= 1 / 401 + 4 * error
    assert risks.mean() >= 1 / 401 - 4 * error  # and no more careful than promised
    assert (risks > 0.02).mean() <= 0.001 + 4 * (0.001 / 4000) ** 0.5
    expected = np.array([1 - choose(rng.random(400), 0.01, "expected").caution for _ in range(4000)])
    assert expected.mean() == pytest.approx(4 / 401, abs=4 * expected.std() / 4000**0.5)
    assert (expected > 0.02).mean() > 0.02  # one calibration in 24 is worse than the other guarantee allows


def autoregressive(phi: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw lognormal delays whose logarithms follow one another."""
    noise = rng.normal(size=count + 1000) * (1 - phi**2) ** 0.5
    return np.exp(signal.lfilter([1], [1, -phi], noise)[1000:])


@pytest.mark.parametrize(
    ("kind", "count"),
    [(0.3, 300), (0.9, 100), (0.99, 400), (-0.5, 400), ("step", 400), ("pauses", 400)],
)
def test_a_calibration_whose_delays_follow_one_another_promises_nothing(kind: float | str, count: int) -> None:
    rng = np.random.default_rng(9)
    if isinstance(kind, float):
        score = autoregressive(kind, count, rng)
    elif kind == "step":
        score = rng.lognormal(0, 0.4, count) * np.where(np.arange(count) < count // 2, 1, 1.5)
    else:
        score = Markov(1.0, 0.2, pause_share=0.05, pause_ratio=4.0, pause_tokens=3.0).sample(rng, count, 1)[:, 0]
    known = choose(score, 0.05, delay=score)
    assert not known.exchangeable
    said = promise({"a": asdict(known)}, "lambda", "plans")
    assert said == no_promise({"a": asdict(known)})
    assert said.startswith("No promise about stalls")
    assert f"a (lag-1 correlation {known.correlation:.3f}, by chance up to {2.58 / count**0.5:.3f})" in said
    assert "%" not in said


def test_independent_delays_are_exchangeable_but_for_one_in_a_hundred() -> None:
    rng = np.random.default_rng(10)
    found = [choose(delay, delay=delay) for delay in rng.lognormal(size=(2000, 400))]
    assert 0.003 < np.mean([not each.exchangeable for each in found]) < 0.015
    assert choose(np.ones(99), delay=np.ones(99)).correlation == 0


def test_a_promise_names_its_assumption_and_leaves_out_what_does_not_meet_it() -> None:
    rng = np.random.default_rng(11)
    good, bad = (choose(delay, delay=delay) for delay in (rng.random(400), np.arange(400.0)))
    known = {"good": asdict(good), "bad": asdict(bad), "later": asdict(replace(good, changed=True))}
    said = promise(known, "lambda", "plans")
    assert "lets at most 0.25% of the plans stall on average, 1.71% with 99.9% confidence (epsilon 0.01), if" in said
    assert f"exchangeable with those of the calibration (lag-1 correlation {good.correlation:.3f}, by chance" in said
    assert said.endswith("bad (lag-1 correlation 0.993, by chance up to 0.129), later (changed since the calibration).")
    older = {name: value for name, value in asdict(good).items() if name not in {"correlation", "changed"}}
    assert promise({"older": older}, "lambda", "plans").endswith("exchangeable with those of the calibration.")


@pytest.mark.parametrize("gaps", [None, BURSTS], ids=["lognormal", "bursts"])
def test_among_exchangeable_plans_no_more_stall_than_promised(gaps: Markov | None) -> None:
    world = replace(WORLD, gaps=gaps)
    rng = np.random.default_rng(7)
    stalls, count = 0, 0
    for _ in range(12):
        calibration = world.draw(rng, 400)
        policy = fitted(calibration)
        policy = replace(policy, caution=calibrate(policy, calibration).caution)
        plans = world.draw(rng, 1000)
        stalls, count = stalls + int(stalled(policy.schedule(plans)).sum()), count + 1000
    assert stats.binomtest(stalls, count, 0.01, alternative="greater").pvalue > 0.01
    assert stalls > 0  # not safe by waiting


def test_too_few_plans_are_refused_with_what_would_do() -> None:
    assert choose(np.zeros(99)).caution == 0
    with pytest.raises(
        UsageError, match=r"calibrating on 98 promises 0\.01 at best.*take 99 or more \(400 are better\)"
    ):
        choose(np.zeros(98))
    with pytest.raises(UsageError, match=r"calibrating on 3 promises 0\.25 at best, not 0\.1: take 9 or more"):
        choose(np.zeros(3), 0.1)
    assert choose(np.zeros(98), 0.02).caution == 0
    for epsilon in (0.0, 1.0, math.nan):
        with pytest.raises(UsageError, match="between 0 and 1"):
            choose(np.zeros(98), epsilon)


@given(stalls=st.integers(0, 50), plans=st.integers(50, 500))
def test_the_upper_bound_is_scipy_s(stalls: int, plans: int) -> None:
    interval = stats.binomtest(stalls, plans).proportion_ci(0.95, "exact")
    assert upper_bound(stalls, plans, 0.975) == pytest.approx(interval.high)


def test_durations_of_all_plans_in_one_column_stay_one_when_some_plans_are_taken() -> None:
    column = np.ones((2, 1))
    plans = Plans(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), column, column, column)
    some = take(plans, np.array([0, 2]))
    assert some.arrival_s.tolist() == [[1.0, 3.0], [4.0, 6.0]]
    assert some.nominal_s is column
    assert take(some, np.array([1])).arrival_s.tolist() == [[3.0], [6.0]]


@pytest.mark.parametrize(("scores_", "caution"), [(98, math.inf), (99, 98.0)])
def test_with_too_few_scores_for_epsilon_the_next_plan_is_waited_for(scores_: int, caution: float) -> None:
    assert Tracker(np.arange(float(scores_)), 0.01).caution == caution


def test_the_level_moves_by_a_step_of_what_went_otherwise_than_epsilon_says() -> None:
    tracker = Tracker([0.0, 1.0, 2.0], 0.25, step=0.5)
    tracker.learn(3.0, stalled=False)
    assert tracker.level == 0.25 + 0.5 * 0.25
    assert tracker.caution == 3.0  # floor(4 x .375) - 1 = 0 scores may lie above
    tracker.learn(math.inf, stalled=True)
    assert tracker.level == 0.375 - 0.5 * 0.75
    assert tracker.level == 0.0
    for _ in range(9):
        tracker.learn(3.0, stalled=False)
    assert tracker.level == 0.5
    assert (Tracker([1.0]).step, Tracker([1.0]).level) == (0.002, 0.01)


@given(stalls=st.lists(st.booleans(), min_size=1, max_size=3000), step=st.floats(0.001, 0.05))
def test_tracking_bounds_the_stalls_whatever_happens(stalls: list[bool], step: float) -> None:
    tracker = Tracker(np.linspace(0, 3, 100), 0.02, step=step)
    level, happened = tracker.level, 0
    for would in stalls:
        stall = would and not math.isinf(tracker.caution)  # a plan that is waited for does not stall
        happened += stall
        tracker.learn(9.0, stalled=stall)
    bound = (level + step) / (step * len(stalls))
    # Infinity needs a level below 1 / (n + 1) only: the bound is looser by what is left below it.
    assert happened / len(stalls) <= 0.02 + bound + 1e-9


def test_tracking_begins_with_the_calibration_and_keeps_as_many_scores() -> None:
    tracker = Tracker([0.0] * 90 + [1.0] * 9 + [5.0], 0.05)
    assert tracker.caution == 1.0
    for _ in range(100):
        tracker.learn(7.0, stalled=False)
    assert tracker.caution == 7.0
    with pytest.raises(ValueError, match="begins with the scores"):
        Tracker([])


SLOW_WORLD = World(0.58, 3.0, 1, 8, 1.0)
TRACKED = SLOW_WORLD.draw(generator(0, "tracking"), 60)


def begin(policy: StreamToAct | None = None) -> TrackedPolicy:
    assert TRACKED.token_s is not None
    return TrackedPolicy.begin(replace(policy or StreamToAct(), prior=GapPrior.fit(TRACKED.token_s)), TRACKED, 0.02)


def slow(plans: int) -> Plans:
    return SLOW_WORLD.draw(generator(1, "tracking"), plans, 1.8)


@pytest.mark.parametrize("policy", [StreamToAct(), StreamToAct(detect=True), EarlyStart()])
def test_arrays_are_plans_one_after_another(policy: StreamToAct) -> None:
    plans, together, alone = slow(16), begin(policy), begin(policy)
    cautions, schedule = together.follow(plans)
    assert len(set(cautions)) > 1
    for column, caution in enumerate(cautions):
        plan = take(plans, np.array([column]))
        assert alone.policy.caution == caution
        decided = alone.policy.schedule(plan)
        np.testing.assert_array_equal(decided.start_s[:, 0], schedule.start_s[:, column])
        np.testing.assert_array_equal(decided.duration_s[:, 0], schedule.duration_s[:, column])
        alone.learn(plan, stalled=bool(stalled(decided)[0]))
    assert (together.tracker.level, together.policy) == (alone.tracker.level, alone.policy)


def test_plans_that_do_not_fit_the_memory_at_once_are_the_same_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    plans, whole, parts = slow(14), begin(), begin()
    cautions, schedule = whole.follow(plans)
    monkeypatch.setattr(conformal, "AT_ONCE", 6)
    again, in_parts = parts.follow(plans)
    assert again.tolist() == cautions.tolist()
    np.testing.assert_array_equal(in_parts.start_s, schedule.start_s)
    np.testing.assert_array_equal(in_parts.duration_s, schedule.duration_s)
    assert (parts.tracker.level, parts.policy) == (whole.tracker.level, whole.policy)
