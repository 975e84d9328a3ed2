"""The policy's contract as one suite: subclass it, and give a fixture `policy`."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from s2a_bench.policy import POLICIES, Plans, PlanShape, Policy, Start, Stepper, Timing
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import least_end, safe_start

EXACT = 1e-9
"""Seconds within which two ways to add up the same times agree."""

shared = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw(seed: int, n_skills: int, tokens_per_skill: int, rho: float, plans: int, gap_cv: float = 0.3) -> Plans:
    """Make random plans without ties, with skills of 0.6 to 1.4 s and gaps of ``rho`` seconds a skill in the mean."""
    rng = np.random.default_rng(seed)
    variance = np.log1p(gap_cv**2)
    gaps = rng.lognormal(-variance / 2, np.sqrt(variance), (n_skills * tokens_per_skill, plans))
    token_s = 0.3 + np.cumsum(gaps * rho / tokens_per_skill, axis=0)
    nominal_s = rng.uniform(0.6, 1.4, (n_skills, plans))
    return Plans(
        arrival_s=token_s[tokens_per_skill - 1 :: tokens_per_skill].copy(),
        nominal_s=nominal_s,
        least_s=nominal_s * rng.uniform(0.7, 1.0, nominal_s.shape),
        most_s=nominal_s * rng.uniform(1.0, 1.6, nominal_s.shape),
        token_s=token_s,
        shape=PlanShape(n_skills, tokens_per_skill, Timing(1.0, 0.8, 1.5)),
    )


def one(plans: Plans, column: int) -> Plans:
    """Take one plan, still as arrays (N, 1)."""
    cut = slice(column, column + 1)
    assert plans.token_s is not None
    return replace(
        plans,
        arrival_s=plans.arrival_s[:, cut],
        nominal_s=plans.nominal_s[:, cut],
        least_s=plans.least_s[:, cut],
        most_s=plans.most_s[:, cut],
        token_s=plans.token_s[:, cut],
    )


seeded = st.builds(
    draw,
    seed=st.integers(0, 2**32 - 1),
    n_skills=st.integers(1, 9),
    tokens_per_skill=st.integers(1, 5),
    rho=st.floats(0.2, 3.0),
    plans=st.integers(1, 4),
    gap_cv=st.sampled_from([0.05, 0.3, 1.0]),
)


@dataclass
class Stream:
    """A stream as it arrives; it ends with the last thing that comes."""

    token_s: Sequence[float]
    arrival_s: Sequence[float]
    timings: Sequence[Timing]

    def instants(self) -> list[tuple[float, list[tuple[int, int]]]]:
        """List when something comes, and what: tokens, then fragments, then the end."""
        events = [(at, 0, 0) for at in self.token_s] + [(at, 1, i) for i, at in enumerate(self.arrival_s)]
        events.append((max(events)[0], 2, 0))
        grouped = groupby(sorted(events), key=lambda event: event[0])
        return [(at_s, [(kind, which) for _, kind, which in group]) for at_s, group in grouped]


class Robot:
    """Carries a stepper's decisions out in virtual time, without delays of its own."""

    def __init__(self, stepper: Stepper, stream: Stream, n_skills: int) -> None:
        self.stepper, self.stream, self.n_skills = stepper, stream, n_skills
        self.running: Start | None = None
        self.starts: list[float] = []
        self.durations: list[float] = []
        self.arrived, self.ended = 0, False

    def hear(self, now_s: float, events: list[tuple[int, int]]) -> None:
        """Tell the stepper what happened."""
        for kind, which in events:
            if kind == 0:
                self.stepper.token(now_s)
            elif kind == 1:
                self.stepper.fragment(now_s, self.stream.timings[which])
                self.arrived += 1
            else:
                self.stepper.end(now_s)
                self.ended = True

    def act(self, now_s: float) -> float:
        """End and start what is due, and say when to act next if nothing happens before."""
        while True:
            wake_s = self.ask(now_s) if self.running is None else self.starts[-1] + self.length_s(self.running)
            if wake_s > now_s:
                return wake_s
            if self.running is not None:
                self.durations.append(now_s - self.starts[-1])
                self.running = None

    def ask(self, now_s: float) -> float:
        """Ask the stepper, and start a skill where it says so."""
        answer = self.stepper.decide(now_s)
        if not isinstance(answer, Start):
            assert answer > now_s, "asked to be asked in the past"
            return answer
        assert self.arrived > len(self.starts), "started a skill that has not arrived"
        assert 0 <= answer.duration_s <= answer.latest_s + EXACT
        self.running = answer
        self.starts.append(now_s)
        return now_s + self.length_s(answer)

    def length_s(self, running: Start) -> float:
        """Say how long the skill runs, as things stand now."""
        next_is_here = self.arrived > len(self.starts)
        none_follows = self.ended or len(self.starts) == self.n_skills
        return running.duration_s if next_is_here or none_follows else max(running.latest_s, running.duration_s)


def follow(stepper: Stepper, stream: Stream, n_skills: int) -> tuple[list[float], list[float]]:
    """Run a stepper on a stream and return starts and durations."""
    robot = Robot(stepper, stream, n_skills)
    wake_s = robot.act(0.0)
    for at_s, events in stream.instants():
        while wake_s < at_s:
            wake_s = robot.act(wake_s)
        robot.hear(at_s, events)
        wake_s = robot.act(at_s)
    while wake_s < math.inf:
        wake_s = robot.act(wake_s)
    return robot.starts, robot.durations


def step(policy: Policy, plans: Plans, *, missing: int = 0) -> tuple[list[float], list[float]]:
    """Follow one plan of shape (N, 1); ``missing`` skills more are expected than come."""
    assert plans.shape is not None
    assert plans.token_s is not None
    first_s = float(safe_start(plans.arrival_s, plans.nominal_s)[0])
    n_skills = plans.shape.n_skills + missing
    timings = [
        Timing(float(nominal), float(least), float(most))
        for nominal, least, most in zip(plans.nominal_s[:, 0], plans.least_s[:, 0], plans.most_s[:, 0], strict=True)
    ]
    stream = Stream(plans.token_s[:, 0].tolist(), plans.arrival_s[:, 0].tolist(), timings)
    return follow(policy.stepper(replace(plans.shape, n_skills=n_skills, safe_start_s=first_s)), stream, n_skills)


class PolicySuite:
    """What every policy does."""

    def test_its_name_is_the_one_it_is_found_by(self, policy: Policy) -> None:
        assert policy.name in POLICIES

    @shared
    @given(plans=seeded)
    def test_the_stepper_and_the_arrays_agree(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        for column in range(plans.arrival_s.shape[1]):
            starts, durations = step(policy, one(plans, column))
            assert starts == pytest.approx(schedule.start_s[:, column].tolist(), abs=EXACT)
            assert durations == pytest.approx(schedule.duration_s[:, column].tolist(), abs=EXACT)

    @shared
    @given(plans=seeded)
    def test_no_skill_starts_before_it_has_arrived(self, policy: Policy, plans: Plans) -> None:
        assert (policy.schedule(plans).start_s >= plans.arrival_s).all()

    @shared
    @given(plans=seeded)
    def test_no_two_skills_run_at_once(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        assert (schedule.start_s[1:] >= (schedule.start_s + schedule.duration_s)[:-1] - EXACT).all()

    @shared
    @given(plans=seeded)
    def test_every_skill_takes_at_least_its_least_and_at_most_its_most(self, policy: Policy, plans: Plans) -> None:
        duration_s = policy.schedule(plans).duration_s
        assert (duration_s >= plans.least_s - EXACT).all()
        assert (duration_s <= plans.most_s + EXACT).all()

    @shared
    @given(plans=seeded)
    def test_a_started_robot_idles_only_when_the_next_skill_is_missing(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        ready_s = np.maximum((schedule.start_s + schedule.duration_s)[:-1], plans.arrival_s[1:])
        np.testing.assert_allclose(schedule.start_s[1:], ready_s, rtol=0, atol=EXACT)

    @shared
    @given(plans=seeded)
    def test_nothing_ends_before_the_elastic_optimum(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        end_s = schedule.start_s[-1] + schedule.duration_s[-1]
        assert (end_s >= least_end(plans.arrival_s, plans.least_s) - EXACT).all()

    @shared
    @given(plans=seeded)
    def test_a_start_before_that_of_the_elastic_optimum_stalls(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        early = schedule.start_s[0] < safe_start(plans.arrival_s, plans.most_s) - EXACT
        assert (stalls(schedule).sum(axis=0)[early] > 0).all()

    @shared
    @given(plans=seeded)
    def test_every_plan_is_decided_by_itself(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        for column in range(plans.arrival_s.shape[1]):
            alone = policy.schedule(one(plans, column))
            np.testing.assert_allclose(alone.start_s[:, 0], schedule.start_s[:, column], rtol=0, atol=EXACT)
            np.testing.assert_allclose(alone.duration_s[:, 0], schedule.duration_s[:, column], rtol=0, atol=EXACT)

    def test_deciding_leaves_the_plans_as_they_are(self, policy: Policy) -> None:
        plans = draw(1, 6, 3, 1.3, 5)
        before = copy.deepcopy(plans)
        policy.schedule(plans)
        for name in ("arrival_s", "nominal_s", "least_s", "most_s", "token_s"):
            np.testing.assert_array_equal(getattr(plans, name), getattr(before, name))

    def test_following_a_plan_leaves_nothing_behind_for_the_next(self, policy: Policy) -> None:
        plans = draw(2, 6, 3, 1.3, 2)
        first = step(policy, one(plans, 0))
        step(policy, one(plans, 1))
        assert step(policy, one(plans, 0)) == first

    @shared
    @given(plans=seeded)
    def test_a_plan_of_one_skill_starts_when_it_arrives(self, policy: Policy, plans: Plans) -> None:
        assert plans.token_s is not None
        assert plans.shape is not None
        single = Plans(
            plans.arrival_s[:1],
            plans.nominal_s[:1],
            plans.least_s[:1],
            plans.most_s[:1],
            plans.token_s[: int(plans.shape.tokens_per_skill)],
            replace(plans.shape, n_skills=1),
        )
        np.testing.assert_array_equal(policy.schedule(single).start_s, single.arrival_s)

    @shared
    @given(plans=seeded)
    def test_a_stream_that_breaks_off_is_carried_out_as_far_as_it_came(self, policy: Policy, plans: Plans) -> None:
        starts, durations = step(policy, one(plans, 0), missing=3)
        assert len(starts) == len(durations) == len(plans.arrival_s)
        assert np.isfinite(starts).all()
        assert np.isfinite(durations).all()

    def test_a_stream_without_a_skill_starts_nothing(self, policy: Policy) -> None:
        stepper = policy.stepper(PlanShape(3, 2, Timing(1.0, 0.8, 1.5), safe_start_s=4.0))
        assert follow(stepper, Stream([0.5, 0.9], [], []), 3) == ([], [])
