"""A policy that follows its lambda does so the same way plan by plan and over arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from s2a_bench.policy import Plans, conformal
from s2a_bench.policy.conformal import TrackedPolicy, stalled, take
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import EarlyStart, StreamToAct
from s2a_bench.stats.seeds import generator
from studies.worlds import World

WORLD = World(0.58, 3.0, 1, 8, 1.0)
CALIBRATION = WORLD.draw(generator(0, "tracking"), 60)


def begin(policy: StreamToAct | None = None) -> TrackedPolicy:
    assert CALIBRATION.token_s is not None
    return TrackedPolicy.begin(
        replace(policy or StreamToAct(), prior=GapPrior.fit(CALIBRATION.token_s)), CALIBRATION, 0.02
    )


def slow(plans: int) -> Plans:
    return WORLD.draw(generator(1, "tracking"), plans, 1.8)


@pytest.mark.parametrize("policy", [StreamToAct(), StreamToAct(detect=True), EarlyStart()])
def test_arrays_are_plans_one_after_another(policy: StreamToAct) -> None:
    plans, together, alone = slow(16), begin(policy), begin(policy)
    cautions, schedule = together.follow(plans)
    assert len(set(cautions)) > 1
    for column, caution in enumerate(cautions):
        plan = take(plans, np.array([column]))
        assert alone.policy.caution == caution
        np.testing.assert_array_equal(alone.policy.schedule(plan).start_s[:, 0], schedule.start_s[:, column])
        alone.learn(plan, stalled=bool(stalled(alone.policy.schedule(plan))[0]))
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
