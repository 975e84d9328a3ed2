"""Every policy keeps the contract; the table of policies, and what is particular to the three that learn nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.errors import UsageError
from s2a_bench.policy import POLICIES, Plans, PlanShape, Policy, Start, Stepper, Timing, policy, stepping
from s2a_bench.policy import policy as build
from s2a_bench.policy.nominal import NominalQueue
from s2a_bench.policy.schedule import work_conserving
from s2a_bench.policy.stepping import Stream, follow
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.testing.policy import EXACT, PolicySuite, draw

SKILL = Timing(1.0, 0.8, 1.5)


def test_an_unknown_policy_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(UsageError, match="`policy`: 'eager' is not one of naive, wait-then-act, stream-to-act"):
        policy("eager")


def test_a_clairvoyant_who_is_told_nothing_is_refused() -> None:
    with pytest.raises(UsageError, match="s2a-clairvoyant needs to know when every skill will arrive"):
        policy("s2a-clairvoyant").stepper(PlanShape(2, 4, SKILL))


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
    stepped, schedule = stepping.schedule(policy(name), plans), policy(name).schedule(plans)
    np.testing.assert_allclose(stepped.start_s, schedule.start_s, rtol=0, atol=EXACT)
    np.testing.assert_allclose(stepped.duration_s, schedule.duration_s, rtol=0, atol=EXACT)


@dataclass(frozen=True)
class AfterTwo(Policy):
    """A policy of one class: it starts with the second skill, or when no other comes."""

    name: ClassVar[str] = "after-two"

    def stepper(self, shape: PlanShape) -> Stepper:
        return NominalQueue(min(2, shape.n_skills))


def test_a_policy_with_a_stepper_alone_decides_for_many_plans() -> None:
    plans = draw(5, 6, 2, 1.3, 20)
    schedule = AfterTwo().schedule(plans)
    started = work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[1])
    np.testing.assert_allclose(schedule.start_s, started, rtol=0, atol=EXACT)
    np.testing.assert_allclose(schedule.duration_s, plans.nominal_s, rtol=0, atol=EXACT)


def test_plans_without_a_shape_cannot_be_stepped_through() -> None:
    with pytest.raises(ValueError, match="after-two decides step by step: plans need shape"):
        AfterTwo().schedule(replace(draw(5, 6, 2, 1.3, 1), shape=None))


@dataclass
class Wrong(NominalQueue):
    """Answers the same whatever happens."""

    answer: Start | float = 0.0

    def decide(self, now_s: float) -> Start | float:  # noqa: ARG002
        return self.answer


@dataclass
class AsTold(Wrong):
    """Starts whatever has arrived with the same answer."""

    def decide(self, now_s: float) -> Start | float:
        return self.answer if isinstance(NominalQueue.decide(self, now_s), Start) else math.inf


@pytest.mark.parametrize(
    ("kind", "answer", "message"),
    [
        (Wrong, 0.0, "decides at 0.0 s wants to decide again at 0.0 s"),
        (Wrong, math.nan, "wants to decide again at nan s"),
        (Wrong, Start(1.0, 1.0), "starts skill 1 at 0.0 s, before it has arrived"),
        (AsTold, Start(-1.0, 2.0), "a skill that takes -1.0 s, 2.0 s at most"),
        (AsTold, Start(2.0, 1.0), "a skill that takes 2.0 s, 1.0 s at most"),
        (AsTold, Start(math.nan, 1.0), "a skill that takes nan s, 1.0 s at most"),
    ],
)
def test_what_no_robot_can_do_is_refused(kind: type[Wrong], answer: Start | float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        follow(kind(answer=answer), Stream([], [1.0], [SKILL]), 1)


def test_a_skill_may_take_no_time_and_its_bound_may_be_less_by_a_rounding() -> None:
    stream = Stream([], [1.0, 2.0], [SKILL, SKILL])
    assert follow(AsTold(answer=Start(0.0, 0.0)), stream, 2) == ([1.0, 2.0], [0.0, 0.0])
    assert follow(AsTold(answer=Start(2.0, 2 - 1e-12)), stream, 3) == ([1.0, 3.0], [2.0, 2.0])


def test_a_stepper_that_gives_up_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AfterTwo, "stepper", lambda _self, _shape: Wrong(answer=math.inf))
    with pytest.raises(ValueError, match="after-two ended with 0 of 3 skills"):
        AfterTwo().schedule(draw(5, 3, 2, 1.3, 1))


@pytest.mark.parametrize("name", POLICIES)
class TestDefaults(PolicySuite):
    @pytest.fixture
    def policy(self, name: str) -> Policy:
        return build(name)


@pytest.mark.parametrize("caution", [0.0, math.inf])
class TestStreamToAct(PolicySuite):
    @pytest.fixture
    def policy(self, caution: float) -> Policy:
        return StreamToAct(caution=caution)
