"""The operating point of the paper's outcome in two simulators, and physics that must hold anywhere."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plan.skillset import GAPS
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.nominal import Clairvoyant, Naive, WaitThenAct
from s2a_bench.scenario import EGO, LEAD, REAR, SIMULATORS
from s2a_bench.scenario.ccrb.cars import FOLLOWERS, Cars, braking_plan
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.ccrb.ego import ACTING, GAP, WAITING

POLICIES = {"naive": Naive(), "wait": WaitThenAct(), "stream": Clairvoyant()}
LISTED = {
    "naive": ("rear", 2.0, None, 0.0),
    "wait": ("front", 12.7, 0.0, None),
    "stream": ("none", None, 13.4, 0.6),
}
"""POLICY section 6: outcome, impact in m/s, least front and rear gap in m."""


MANY = 40
seeds = pytest.mark.parametrize("seed", range(2))
laws = pytest.mark.parametrize("follower", list(FOLLOWERS))


def schedule(policy: str, rate: float = 4.8, n_skills: int = 5, t_nom_s: float = 0.8) -> Schedule:
    nominal = np.full((n_skills, 1), t_nom_s)
    return POLICIES[policy].schedule(Plans(uniform(0.5, 6, rate, n_skills), nominal, 0.8 * nominal, 1.5 * nominal))


def go(cars: Cars, planned: Schedule, world: str = "longitudinal", **how: Any) -> Driven:
    return drive(SIMULATORS[world](), cars, braking_plan(cars, 5, 0.8), planned, **how)


def times(planned: Schedule, count: int) -> Schedule:
    return Schedule(np.tile(planned.start_s, (1, count)), np.tile(planned.duration_s, (1, count)))


@cache
def driven(world: str, policy: str, **changed: Any) -> Driven:
    return go(Cars(**changed), schedule(policy), world, record=True)


@pytest.mark.parametrize("world", ["longitudinal", "embedded"])
@pytest.mark.parametrize("policy", LISTED)
def test_the_operating_point_is_within_a_tenth_of_what_is_listed(world: str, policy: str) -> None:
    outcome, *listed = LISTED[policy]
    outcomes = driven(world, policy).outcomes
    assert outcomes.name(0) == outcome
    for name, wanted in zip(("impact_speed_mps", "min_front_gap_m", "min_rear_gap_m"), listed, strict=True):
        if wanted is not None:
            assert getattr(outcomes, name)[0] == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize(
    ("policy", "gap"), [*(("naive", gap) for gap in GAPS), ("wait", Cars().gap), ("stream", Cars().gap)]
)  # naive alone has gaps
def test_the_bare_integrator_agrees_with_the_full_simulator(policy: str, gap: str) -> None:
    bare, full = driven("longitudinal", policy, gap=gap), driven("embedded", policy, gap=gap)
    assert bare.outcomes.name(0) == full.outcomes.name(0)
    steps = min(len(bare.trajectory.time_s), len(full.trajectory.time_s))
    apart = bare.trajectory.position_m[:steps] - full.trajectory.position_m[:steps]
    assert np.abs(apart).max() < 0.15
    assert np.abs(bare.trajectory.speed_mps[:steps] - full.trajectory.speed_mps[:steps]).max() < 0.15


@laws
def test_in_lock_step_roll_outs_come_out_as_alone(follower: str) -> None:
    gaps, delays = np.array([8.0, 14.0, 26.0]), np.array([0.9, 1.3, 1.7])
    naive = schedule("naive")
    alone = [
        go(Cars(rear_gap_m=gap, reaction_s=delay, follower=follower), naive).outcomes
        for gap, delay in zip(gaps, delays, strict=True)
    ]
    together = go(Cars(rear_gap_m=gaps, reaction_s=delays, follower=follower), times(naive, 3)).outcomes
    assert together.code.tolist() == [int(one.code[0]) for one in alone]
    assert together.min_rear_gap_m == pytest.approx([one.min_rear_gap_m[0] for one in alone], abs=0.02)
    assert together.min_front_gap_m == pytest.approx([one.min_front_gap_m[0] for one in alone], abs=1e-9)


def test_nobody_stalls_or_is_hit_where_tokens_come_fast() -> None:
    for policy in POLICIES:
        assert go(Cars(rear_gap_m=25.0), schedule(policy, rate=50)).outcomes.name(0) == "none"


def test_before_the_first_skill_the_ego_cruises_and_in_a_gap_it_brakes() -> None:
    path = driven("longitudinal", "naive").trajectory
    waiting, between = path.phase[:, 0] == WAITING, path.phase[:, 0] == GAP
    assert path.speed_mps[waiting, EGO, 0] == pytest.approx(50 / 3.6)
    assert path.time_s[waiting][-1] == pytest.approx(1.75, abs=0.011)
    assert between.sum() * 0.01 == pytest.approx(4 * 0.45, abs=0.05)
    assert path.acceleration_mps2[between, EGO, 0].min() == -8.0
    assert (path.acceleration_mps2[path.phase[:, 0] == ACTING, EGO, 0] <= 2.0).all()


def test_the_reflex_layer_saves_the_one_who_waits() -> None:
    plain, reflex = driven("longitudinal", "wait").outcomes, driven("longitudinal", "wait", reflex=True).outcomes
    assert plain.name(0) == "front"
    assert not int(reflex.code[0]) & 1
    assert reflex.min_front_gap_m[0] > 0


@pytest.mark.slow
@laws
def test_a_drive_that_ends_when_all_is_decided_has_the_outcome_of_a_long_one(follower: str) -> None:
    for seed in (11, 12):
        cars, many = draw(seed, follower, reflex=False)
        short, long = (go(cars, many, resting_mps=resting_mps).outcomes for resting_mps in (0.5, -1.0))
        assert short.code.tolist() == long.code.tolist()
        assert short.impact_speed_mps == pytest.approx(long.impact_speed_mps, nan_ok=True)


def test_a_lane_change_needs_a_simulator_that_steers() -> None:
    plan = braking_plan(Cars(), 5, 0.8, lane_change=True)
    with pytest.raises(UsageError, match=r"`lane_change`: .* take `simulator` embedded"):
        drive(SIMULATORS["longitudinal"](), Cars(), plan, schedule("naive", n_skills=6))


def test_the_embedded_simulator_changes_lanes_and_passes_the_lead() -> None:
    cars = Cars()
    each = schedule("naive", n_skills=6)
    each.duration_s[-1] = 5.0
    found = drive(SIMULATORS["embedded"](), cars, braking_plan(cars, 5, 0.8, lane_change=True), each, record=True)
    assert found.outcomes.name(0) == "none"
    path = found.trajectory
    assert path.lateral_m[-1, EGO, 0] == pytest.approx(4.0, abs=0.3)
    assert path.position_m[-1, EGO, 0] > path.position_m[-1, LEAD, 0]


def test_a_world_for_one_refuses_many() -> None:
    with pytest.raises(UsageError, match="runs 1 roll-out at a time, not 2"):
        go(Cars(), times(schedule("naive"), 2), "embedded")


def draw(seed: int, follower: str, *, reflex: bool) -> tuple[Cars, Schedule]:
    """Draw many scenarios, of all kinds, with plans at many rates under all policies."""
    rng = np.random.default_rng(seed)
    cars = Cars(
        front_gap_m=rng.uniform(8, 80, MANY),
        lead_decel_mps2=rng.uniform(1, 8, MANY),
        rear_gap_m=rng.uniform(4, 40, MANY),
        reaction_s=rng.uniform(0, 2, MANY),
        speed_mps=rng.uniform(5, 25, MANY),
        gap=rng.choice(GAPS, MANY),
        follower=follower,
        reflex=reflex,
    )
    rates, policies = rng.uniform(2, 20, MANY), rng.choice(sorted(POLICIES), MANY)
    each = [schedule(policy, rate) for policy, rate in zip(policies, rates, strict=True)]
    start_s = np.concatenate([one.start_s for one in each], axis=1)
    duration_s = np.concatenate([one.duration_s for one in each], axis=1)
    return cars, Schedule(start_s, duration_s)


@pytest.mark.slow
@seeds
@laws
def test_physics_holds_in_any_scenario(seed: int, follower: str) -> None:
    found = go(*draw(seed, follower, reflex=bool(seed)), record=True)
    path, outcomes = found.trajectory, found.outcomes
    assert (path.speed_mps >= 0).all()
    assert (np.diff(path.position_m, axis=0) >= -1e-9).all()
    ego = path.acceleration_mps2[:, EGO]
    assert (ego >= -8 - 1e-9).all()
    assert (ego <= 2 + 1e-9).all()
    assert (path.acceleration_mps2[:, REAR] >= -7 - 1e-9).all()
    moving = np.minimum(path.speed_mps[1:, EGO], path.speed_mps[:-1, EGO]) > 0.2  # at rest the brake is let go at once
    assert (np.abs(np.diff(ego, axis=0))[moving] <= 30 * 0.01 + 1e-9).all()
    front, rear = outcomes.code & 1 > 0, outcomes.code & 2 > 0
    assert (outcomes.min_front_gap_m[front] == 0).all()
    assert (outcomes.min_rear_gap_m[rear] == 0).all()
    assert (np.isnan(outcomes.impact_speed_mps) == (outcomes.code == 0)).all()
    assert not (outcomes.impact_speed_mps <= 0.5).any()


@pytest.mark.slow
@seeds
def test_more_room_ahead_never_makes_the_front_worse(seed: int) -> None:
    cars, many = draw(seed, "careful", reflex=False)  # with the reflex the ego itself drives otherwise
    near, far = (go(replace(cars, front_gap_m=cars.front_gap_m + more), many).outcomes for more in (0.0, 5.0))
    assert (far.min_front_gap_m >= near.min_front_gap_m - 1e-9).all()
    assert ((far.code & 1) <= (near.code & 1)).all()


@pytest.mark.slow
@seeds
def test_the_ego_does_not_look_behind(seed: int) -> None:
    cars, many = draw(seed, "careful", reflex=False)
    here = go(cars, many, record=True).trajectory
    elsewhere = go(replace(cars, rear_gap_m=100.0, reaction_s=0.1), many, record=True).trajectory
    steps = min(len(here.time_s), len(elsewhere.time_s))
    assert (here.position_m[:steps, [LEAD, EGO]] == elsewhere.position_m[:steps, [LEAD, EGO]]).all()
