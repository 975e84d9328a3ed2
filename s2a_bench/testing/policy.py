"""The conformance suite of policies."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from s2a_bench.policy import POLICIES, Plans, PlanShape, Policy, Timing, stepping
from s2a_bench.policy.conformal import take
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import least_end, safe_start
from s2a_bench.policy.stepping import Stream, follow, step

EXACT = 1e-9
"""Tolerance, in seconds, between two ways to add up the same times."""

shared = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw(seed: int, n_skills: int, tokens_per_skill: int, rho: float, plans: int, gap_cv: float = 0.3) -> Plans:
    """Make random plans without ties, with skills of 0.6 to 1.4 s and gaps of ``rho`` seconds a skill on average."""
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
    return take(plans, np.array([column]))


seeded = st.builds(
    draw,
    seed=st.integers(0, 2**32 - 1),
    n_skills=st.integers(1, 9),
    tokens_per_skill=st.integers(1, 5),
    rho=st.floats(0.2, 3.0),
    plans=st.integers(1, 4),
    gap_cv=st.sampled_from([0.05, 0.3, 1.0]),
)


def for_random_plans(test: Callable[..., None]) -> Callable[..., None]:
    return shared(given(plans=seeded)(test))


class PolicySuite:
    """Fixture: ``policy``, whose name is in `POLICIES`."""

    def test_its_name_is_the_one_it_is_found_by(self, policy: Policy) -> None:
        assert policy.name in POLICIES

    @for_random_plans
    def test_the_stepper_and_the_arrays_agree(self, policy: Policy, plans: Plans) -> None:
        schedule, stepped = policy.schedule(plans), stepping.schedule(policy, plans)
        np.testing.assert_allclose(stepped.start_s, schedule.start_s, rtol=0, atol=EXACT)
        np.testing.assert_allclose(stepped.duration_s, schedule.duration_s, rtol=0, atol=EXACT)

    @for_random_plans
    def test_no_skill_starts_before_it_has_arrived(self, policy: Policy, plans: Plans) -> None:
        assert (policy.schedule(plans).start_s >= plans.arrival_s).all()

    @for_random_plans
    def test_no_two_skills_run_at_once(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        assert (schedule.start_s[1:] >= (schedule.start_s + schedule.duration_s)[:-1] - EXACT).all()

    @for_random_plans
    def test_every_skill_takes_at_least_its_least_and_at_most_its_most(self, policy: Policy, plans: Plans) -> None:
        duration_s = policy.schedule(plans).duration_s
        assert (duration_s >= plans.least_s - EXACT).all()
        assert (duration_s <= plans.most_s + EXACT).all()

    @for_random_plans
    def test_a_started_robot_idles_only_when_the_next_skill_is_missing(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        ready_s = np.maximum((schedule.start_s + schedule.duration_s)[:-1], plans.arrival_s[1:])
        np.testing.assert_allclose(schedule.start_s[1:], ready_s, rtol=0, atol=EXACT)

    @for_random_plans
    def test_nothing_ends_before_the_elastic_optimum(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        end_s = schedule.start_s[-1] + schedule.duration_s[-1]
        assert (end_s >= least_end(plans.arrival_s, plans.least_s) - EXACT).all()

    @for_random_plans
    def test_a_start_before_that_of_the_elastic_optimum_stalls(self, policy: Policy, plans: Plans) -> None:
        schedule = policy.schedule(plans)
        early = schedule.start_s[0] < safe_start(plans.arrival_s, plans.most_s) - EXACT
        assert (stalls(schedule).sum(axis=0)[early] > 0).all()

    @for_random_plans
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
        first = step(policy, plans, 0)
        step(policy, plans, 1)
        assert step(policy, plans, 0) == first

    @for_random_plans
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

    @for_random_plans
    def test_a_stream_that_breaks_off_is_carried_out_as_far_as_it_came(self, policy: Policy, plans: Plans) -> None:
        starts, durations = step(policy, plans, missing=3)
        assert len(starts) == len(durations) == len(plans.arrival_s)
        assert np.isfinite(starts).all()
        assert np.isfinite(durations).all()

    def test_a_stream_without_a_skill_starts_nothing(self, policy: Policy) -> None:
        stepper = policy.stepper(PlanShape(3, 2, Timing(1.0, 0.8, 1.5), safe_start_s=4.0))
        assert follow(stepper, Stream([0.5, 0.9], [], []), 3) == ([], [])
