"""A policy that follows its lambda does so the same way plan by plan and over arrays, and goes on where it was."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, tracking
from s2a_bench.policy.conformal import stalled, take
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import EarlyStart, StreamToAct
from s2a_bench.policy.tracking import TrackedPolicy
from s2a_bench.stats.seeds import generator
from studies.worlds import World

WORLD = World(0.58, 3.0, 1, 8, 1.0)
CALIBRATION = WORLD.draw(generator(0, "tracking"), 120)


def begin(policy: StreamToAct | None = None) -> TrackedPolicy:
    assert CALIBRATION.token_s is not None
    return TrackedPolicy.begin(
        replace(policy or StreamToAct(), prior=GapPrior.fit(CALIBRATION.token_s)), CALIBRATION, 0.02
    )


def slow(plans: int) -> Plans:
    return WORLD.draw(generator(1, "tracking"), plans, 1.8)


@pytest.mark.parametrize("policy", [StreamToAct(), StreamToAct(detect=True), EarlyStart()])
def test_arrays_are_plans_one_after_another(policy: StreamToAct) -> None:
    plans, together, alone = slow(40), begin(policy), begin(policy)
    cautions, schedule = together.follow(plans)
    assert len(set(cautions)) > 1
    for column, caution in enumerate(cautions):
        plan = take(plans, np.array([column]))
        assert alone.policy.caution == caution
        np.testing.assert_array_equal(alone.policy.schedule(plan).start_s[:, 0], schedule.start_s[:, column])
        alone.learn(plan, stalled=bool(stalled(alone.policy, plan)[0]))
    assert together.state() == alone.state()


def test_plans_that_do_not_fit_the_memory_at_once_are_the_same_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    plans, whole, parts = slow(20), begin(), begin()
    cautions, schedule = whole.follow(plans)
    monkeypatch.setattr(tracking, "AT_ONCE", 6)
    again, in_parts = parts.follow(plans)
    assert again.tolist() == cautions.tolist()
    np.testing.assert_array_equal(in_parts.start_s, schedule.start_s)
    np.testing.assert_array_equal(in_parts.duration_s, schedule.duration_s)
    assert parts.state() == whole.state()


def test_it_goes_on_from_its_state() -> None:
    plans, whole, first = slow(60), begin(), begin()
    whole.follow(plans)
    first.follow(take(plans, np.arange(25)))
    state = json.loads(json.dumps(first.state()))
    rest = TrackedPolicy.resume(StreamToAct(), state)
    rest.follow(take(plans, np.arange(25, 60)))
    assert rest.state() == whole.state()
    assert rest.policy == whole.policy


@pytest.mark.parametrize(
    "change",
    [
        {"scores": []},
        {"scores": ["many"]},
        {"scores": [-1.0]},
        {"level": "high"},
        {"level": float("nan")},
        {"epsilon": 2.0},
        {"prior": {"mean_s": 1.0}},
        {"prior": {"mean_s": -1.0, "plan_cv": 0.1, "token_cv": 0.1}},
        {"prior": 3},
    ],
)
def test_what_is_no_state_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        TrackedPolicy.resume(StreamToAct(), begin().state() | change)
