"""The table of policies, and what is particular to the three that learn nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Start, Timing, policy
from s2a_bench.testing.policy import EXACT, step

SKILL = Timing(1.0, 0.8, 1.5)


def test_an_unknown_policy_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(UsageError, match="--policy: 'eager' is none of naive, wait-then-act, stream-to-act"):
        policy("eager")


def test_a_clairvoyant_who_is_told_nothing_is_refused() -> None:
    with pytest.raises(UsageError, match="s2a-clairvoyant needs to know when every skill will arrive"):
        policy("s2a-clairvoyant").stepper(PlanShape(2, 4, SKILL))


def test_naive_starts_at_once_and_never_holds_on() -> None:
    stepper = policy("naive").stepper(PlanShape(3, 4, SKILL))
    assert stepper.decide(0.0) == math.inf
    stepper.fragment(1.0, SKILL)
    assert stepper.decide(1.0) == Start(1.0, 1.0)
    assert stepper.decide(2.0) == math.inf


def test_wait_then_act_starts_with_the_last_skill_or_when_the_stream_ends_before() -> None:
    for ends in (False, True):
        stepper = policy("wait-then-act").stepper(PlanShape(2, 4, SKILL))
        stepper.fragment(1.0, SKILL)
        assert stepper.decide(1.0) == math.inf
        if ends:
            stepper.end(2.0)
        else:
            stepper.fragment(2.0, SKILL)
        assert stepper.decide(2.0) == Start(1.0, 1.0)


def test_clairvoyant_waits_for_its_start_with_skills_in_hand() -> None:
    stepper = policy("s2a-clairvoyant").stepper(PlanShape(2, 4, SKILL, safe_start_s=3.0))
    stepper.fragment(1.0, SKILL)
    assert stepper.decide(1.0) == 3.0
    assert stepper.decide(3.0) == Start(1.0, 1.0)


@settings(deadline=None, max_examples=100)
@given(
    st.sampled_from(["naive", "wait-then-act", "s2a-clairvoyant"]),
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=7),
)
def test_ties_between_arrivals_and_ends_are_decided_alike_in_both_forms(
    name: str, skills: list[tuple[int, int]]
) -> None:
    arrival_s = np.cumsum([float(gap) for gap, _ in skills])[:, np.newaxis]
    nominal_s = np.array([[float(duration)] for _, duration in skills])
    plans = Plans(arrival_s, nominal_s, nominal_s, nominal_s, arrival_s, PlanShape(len(skills), 1, SKILL))
    starts, durations = step(policy(name), plans)
    schedule = policy(name).schedule(plans)
    assert starts == pytest.approx(schedule.start_s[:, 0].tolist(), abs=EXACT)
    assert durations == pytest.approx(schedule.duration_s[:, 0].tolist(), abs=EXACT)
