"""A change of the rate within a plan: found soon, not found where there is none, and answered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.policy.changes import ChangeWatch, learned_along
from s2a_bench.policy.conformal import calibrate, stalled
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import measure, stalls
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.stats.seeds import generator
from studies.shift import SHIFTS
from studies.worlds import World
from tests.policy import plain

PRIOR = GapPrior(0.2, 0.1, 0.2)
WORLD = World(4.8, 0.5, 6, 8, 1.0)


def even(*gaps_s: float) -> np.ndarray:
    return 1.0 + np.cumsum([0.0, *gaps_s])[:, np.newaxis]


STRETCHES = st.lists(st.tuples(st.sampled_from([0.02, 0.1, 0.2, 0.4, 0.9]), st.integers(1, 12)), min_size=1, max_size=6)
"""Gaps in s, and how many of them follow one another."""


@given(stretches=STRETCHES, plan_cv=st.floats(0.02, 1.0), token_cv=st.floats(0.05, 0.5), seed=st.integers(0, 99))
def test_it_is_the_plain_rule_for_plans_side_by_side(
    stretches: list[tuple[float, int]], plan_cv: float, token_cv: float, seed: int
) -> None:
    gaps = np.array([0.0, *(gap for gap, count in stretches for _ in range(count))])
    token_s = 1.0 + np.cumsum(np.array([gaps, gaps[::-1]]).T, axis=0)
    token_s += np.random.default_rng(seed).uniform(0, 0.01, token_s.shape).cumsum(axis=0)
    prior = GapPrior(0.2, plan_cv, token_cv)
    watch, found = ChangeWatch(prior, 2), []
    for at_s in token_s:
        watch.token(at_s)
        found.append((*watch.learned, watch.slow.copy()))
    for column in range(2):
        learned_rows = plain.watched(0.2, plan_cv, token_cv, token_s[:, column].tolist())
        for row, (mean_s, variance, slow) in enumerate(learned_rows):
            assert found[row][0][column] == pytest.approx(mean_s)
            assert found[row][1][column] == pytest.approx(variance)
            assert found[row][2][column] == slow


def test_a_rate_that_halves_is_learned_within_two_tokens_and_forgotten_when_it_recovers() -> None:
    token_s = even(*[0.2] * 20, *[0.4] * 6, *[0.2] * 20)
    mean_s, _ = learned_along(PRIOR, token_s)
    plain = PRIOR.learned(22.0, 20 * 0.2 + 2 * 0.4)[0]
    assert plain < 0.22
    assert mean_s[22, 0] == pytest.approx(0.4, rel=0.1)
    assert mean_s[26, 0] == pytest.approx(0.4, rel=0.02)
    assert mean_s[-1, 0] < 0.25


def test_plans_as_calibrated_are_hardly_ever_taken_for_slow() -> None:
    plans = WORLD.draw(generator(1, "calm"), 1000)
    assert plans.token_s is not None
    watch = ChangeWatch(GapPrior.fit(plans.token_s), 1000)
    ever = np.zeros(1000, dtype=bool)
    for at_s in plans.token_s:
        watch.token(at_s)
        ever |= watch.slow
    assert ever.mean() < 0.15


def test_detection_costs_nothing_without_a_change_and_saves_stalls_with_one() -> None:
    world = World(0.58, 3.0, 1, 16, 2.0)
    rng = generator(2, "halves")
    calibration = world.draw(rng, 400)
    assert calibration.token_s is not None
    plain = StreamToAct(GapPrior.fit(calibration.token_s))
    calm, slow = world.draw(rng, 400), SHIFTS["rate halves in mid-plan"](world, rng, 400)
    schedules = {}
    for detect in (False, True):
        policy = replace(plain, detect=detect)
        policy = replace(policy, caution=calibrate(policy, calibration).caution)
        schedules[detect] = policy.schedule(calm), policy.schedule(slow)
    (calm_without, slow_without), (calm_with, slow_with) = schedules.values()
    late, expected = (measure(calm, each).start_regret.mean() for each in (calm_with, calm_without))
    assert late == pytest.approx(expected, abs=0.02)
    assert stalled(calm_with).mean() <= 0.02
    assert stalled(slow_with).mean() < 0.75 * stalled(slow_without).mean()
    assert (stalls(slow_with) > 1e-6).sum() < 0.7 * (stalls(slow_without) > 1e-6).sum()


def test_a_robot_that_cannot_make_it_holds_once_instead_of_again_and_again() -> None:
    rng = generator(3, "hold")
    slow = SHIFTS["rate halves in mid-plan"](WORLD, rng, 200)
    policy = StreamToAct(GapPrior(1 / 4.8, 0.1, 0.2), 2.33)
    stops = {d: (stalls(replace(policy, detect=d).schedule(slow)) > 1e-6).sum(axis=0).mean() for d in (False, True)}
    assert stops[False] > 2
    assert stops[True] < 1.3
