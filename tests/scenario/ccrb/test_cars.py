"""The scenario's numbers: plan, deadline, laws, and the start that the car ahead allows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plan import load_skills
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import safe_start
from s2a_bench.scenario import SIMULATORS
from s2a_bench.scenario.ccrb.cars import FOLLOWERS, SAFETY_M, Cars, braking_plan, start_deadline, ttc_aware
from s2a_bench.scenario.ccrb.drive import drive
from s2a_bench.scenario.ccrb.follower import IDM_COMFORT_MPS2, IDM_HASTE, IDM_STANDSTILL_M, idm_acceleration, needed
from s2a_bench.scenario.ccrb.options import CcrbOptions


def test_the_plan_lowers_the_speed_evenly_to_rest_or_to_half_before_a_lane_change() -> None:
    points = braking_plan(Cars(speed_mps=10.0), 4, 0.5).set_point_mps[:, 0]
    assert points == pytest.approx([10.0, 7.5, 5.0, 2.5, 0.0])
    plan = braking_plan(Cars(speed_mps=10.0), 2, 0.5, lane_change=True)
    assert plan.set_point_mps[:, 0] == pytest.approx([10.0, 7.5, 5.0, 5.0])
    assert plan.lane == (0, 0, 1)


@pytest.mark.parametrize("lane_change", [False, True])
def test_the_plan_is_made_of_calls_of_the_driving_skill_set(lane_change: bool) -> None:
    options = CcrbOptions(lane_change=lane_change, n_skills=5)
    known = {str(call) for call in load_skills("driving").calls}
    assert {str(call) for call in options.calls} <= known
    assert {call.skill.gap for call in options.calls} == {options.gap}
    assert len(options.driving.lane) == 5 + lane_change


def least_gap(cars: Cars, decel: float, start_s: float) -> float:
    """Drive in closed steps: the lead brakes at once, the ego from ``start_s`` on; return the least gap."""
    time_s = np.arange(0, 40, 1e-3)
    places = []
    for first, brake, begins in ((cars.front_gap_m, cars.lead_decel_mps2, 0.0), (0.0, decel, start_s)):
        speed = np.maximum(cars.speed_mps - brake * np.maximum(time_s - begins, 0), 0)
        places.append(first + np.cumsum(speed) * 1e-3)
    return float((places[0] - places[1]).min())


@given(st.floats(10, 60), st.floats(1, 7), st.floats(1, 7.5), st.floats(8, 25))
def test_who_starts_at_the_deadline_just_keeps_the_safety_distance(
    gap_m: float, lead: float, own: float, speed: float
) -> None:
    cars = Cars(front_gap_m=gap_m, lead_decel_mps2=lead, speed_mps=speed)
    deadline_s = float(start_deadline(cars, own))
    if deadline_s > 0.01:
        assert least_gap(cars, own, deadline_s) == pytest.approx(SAFETY_M, abs=0.1)


@given(st.floats(5, 30), st.floats(1, 60), st.floats(0, 30), st.floats(0, 8))
def test_braking_as_needed_just_avoids_the_car_ahead(speed: float, room: float, ahead: float, decel: float) -> None:
    need = float(needed(np.array([speed]), np.array([room]), np.array([ahead]), np.array([decel]))[0])
    decel = decel if decel > 0.5 else 0.0
    alike_s = (speed - ahead) / need if need else 0.0  # a little faster than the car ahead, it brakes for minutes
    step_s = 2e-3 * max(1.0, alike_s / 60)
    time_s = np.arange(0, 80, 2e-3) * (step_s / 2e-3)
    mine = np.maximum(speed - need * time_s, 0)
    theirs = np.maximum(ahead - decel * time_s, 0)
    gaps = room + np.cumsum(theirs - mine) * step_s
    together = np.flatnonzero(mine <= theirs)
    closest = gaps[: together[0] + 1].min() if len(together) and not decel else gaps.min()
    assert closest >= -0.1 - 0.02 * room
    if need > decel + 1e-6 and speed > ahead:
        assert closest <= 0.1 + 0.02 * room


def test_our_idm_is_highway_envs() -> None:
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.kinematics import Vehicle

    road = Road(RoadNetwork.straight_road_network(1, speed_limit=100), np_random=np.random.RandomState(0))
    for gap, speed, ahead in ((14.0, 13.9, 13.9), (8.0, 12.0, 6.0), (30.0, 5.0, 6.0), (3.0, 1.0, 0.0)):
        mine = IDMVehicle(road, np.array([100.0, 0.0]), speed=speed, target_speed=IDM_HASTE * 13.9)
        mine.COMFORT_ACC_MAX, mine.COMFORT_ACC_MIN = 1.5, -IDM_COMFORT_MPS2
        mine.DISTANCE_WANTED, mine.TIME_WANTED, mine.DELTA = IDM_STANDSTILL_M, 0.6, 4.0
        theirs = mine.acceleration(mine, Vehicle(road, np.array([100.0 + gap, 0.0]), speed=ahead))
        ours = idm_acceleration(*(np.array([value]) for value in (gap, speed, speed - ahead, IDM_HASTE * 13.9, 0.6)))
        assert ours[0] == pytest.approx(theirs, rel=1e-6)


def test_at_steady_speed_no_follower_does_anything() -> None:
    for follower in FOLLOWERS:
        cars = Cars(follower=follower, front_gap_m=1000.0, lead_decel_mps2=0.01)
        later = Schedule(np.array([[4.0]]), np.array([[2.0]]))
        path = drive(SIMULATORS["longitudinal"](), cars, braking_plan(cars, 1, 2.0), later, record=True).trajectory
        assert np.abs(path.acceleration_mps2[path.time_s < 4, 2]).max() < 1e-9


@given(st.floats(2, 12), st.floats(-1, 12))
def test_the_ttc_aware_start_keeps_the_deadline_wherever_that_is_stall_free(rate: float, deadline_s: float) -> None:
    nominal = np.full((5, 1), 0.8)
    plans = Plans(uniform(0.5, 6, rate, 5), nominal, 0.8 * nominal, 1.5 * nominal)
    safe, least = (float(safe_start(plans.arrival_s, span)[0]) for span in (plans.nominal_s, plans.most_s))
    schedule, (late,) = ttc_aware(plans, deadline_s)
    first = float(schedule.start_s[0, 0])
    assert bool(late) == (least > deadline_s)
    assert (schedule.start_s >= plans.arrival_s - 1e-9).all()
    assert (schedule.duration_s <= plans.most_s + 1e-9).all()
    if safe <= deadline_s:
        assert first == pytest.approx(safe)
        assert schedule.duration_s == pytest.approx(plans.nominal_s)
    elif least <= deadline_s:
        assert first == pytest.approx(deadline_s)
    else:
        assert first == pytest.approx(float(plans.arrival_s[0, 0]))
    if not late:
        assert stalls(schedule).max() <= 1e-9
