"""The numbers of a timeline, on plans small enough to do by hand."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.policy import Plans, Schedule, policy
from s2a_bench.policy.metrics import PlanMetrics, fluidity, measure, stalls
from s2a_bench.testing.policy import draw
from tests.policy import plain


def column(*values: float) -> np.ndarray:
    return np.array(values)[:, np.newaxis]


PLANS = Plans(column(1.0, 4.0, 5.0), column(1.0, 2.0, 1.0), column(0.5, 1.0, 0.5), column(2.0, 4.0, 2.0))
"""S0 = max(1, 3, 2) = 3, E = 3 + 4 = 7, S_lo = max(1, 2, -1) = 2, E_lo = max(1, 3.5, 3.5) + 2 = 5.5, t_N = 5."""


def test_naive_by_hand() -> None:
    found = measure(PLANS, policy("naive").schedule(PLANS))
    assert found.first_action_s == [1.0]
    assert found.end_s == [7.0]
    assert (found.stalls, found.stall_s, found.longest_stall_s) == ([1], [2.0], [2.0])
    assert found.stall_ratio == [2 / 6]
    assert found.start_regret == [0.0]
    assert found.signed_start_regret == [-2 / 3]
    assert found.start_regret_elastic == [0.0]
    assert found.start_regret_of_wait == [0.0]
    assert found.end_regret == [0.0]
    assert found.end_regret_of_wait == [0.0]
    assert found.end_regret_elastic == [1.5 / 5.5]
    assert found.mean_queue_wait_s == pytest.approx([1 / 3])  # the third skill lies ready from 5 to 6
    assert found.longest_queue_wait_s == [1.0]
    assert found.mean_action_age_s == pytest.approx([(1 + 4 + 6) / 3])
    assert found.oldest_action_s == [6.0]
    assert found.speed_distortion == [1.0]
    assert found.fluidity == [2 / 5]  # two met; 2 s late on a budget of 1 s misses three


def test_wait_then_act_by_hand() -> None:
    found = measure(PLANS, policy("wait-then-act").schedule(PLANS))
    assert found.first_action_s == [5.0]
    assert found.end_s == [9.0]
    assert (found.stalls, found.stall_s, found.stall_ratio) == ([0], [0.0], [0.0])
    assert found.start_regret == [2 / 3]
    assert found.signed_start_regret == [2 / 3]
    assert found.start_regret_elastic == [3 / 2]
    assert found.start_regret_of_wait == [1.0]
    assert found.end_regret == [2 / 7]
    assert found.end_regret_of_wait == [1.0]
    assert found.fluidity == [1.0]


@pytest.mark.parametrize("name", ["naive", "wait-then-act"])
def test_shares_are_the_same_for_a_plan_of_a_sixteenth_of_the_time(name: str) -> None:
    short = Plans(PLANS.arrival_s / 16, PLANS.nominal_s / 16, PLANS.least_s / 16, PLANS.most_s / 16)
    found, slow = (measure(plans, policy(name).schedule(plans)) for plans in (short, PLANS))
    for field in fields(PlanMetrics):
        value, long = getattr(found, field.name), getattr(slow, field.name)
        assert value == (long / 16 if field.name.endswith("_s") else long), field.name


def test_holding_on_is_slow_motion_and_no_stall() -> None:
    schedule = Schedule(column(1.0, 4.0, 6.0), column(2.0, 2.0, 1.0))
    found = measure(PLANS, schedule)
    assert found.stall_s == [1.0]
    assert found.speed_distortion == [5 / 4]


def test_a_short_stall_counts_in_the_total_and_not_as_stop_and_go() -> None:
    schedule = Schedule(column(0.0, 1.015625, 2.25), column(1.0, 1.0, 1.0))
    found = measure(PLANS, schedule)
    assert found.stalls == [1]
    assert found.stall_s == [0.25]
    assert measure(PLANS, schedule, tolerance_s=1e-6).stalls == [2]


def test_a_stall_as_long_as_the_tolerance_misses_no_deadline() -> None:
    found = measure(PLANS, Schedule(column(0.0, 1.25, 2.75), column(1.0, 1.0, 1.0)), tolerance_s=0.25)
    assert found.stalls == [1]
    assert found.fluidity == [2 / 3]


def test_a_regret_over_nothing_is_absent() -> None:
    single = Plans(column(2.0), column(1.0), column(1.0), column(1.0))
    found = measure(single, policy("naive").schedule(single))
    assert math.isnan(found.start_regret_of_wait[0])
    assert math.isnan(found.end_regret_of_wait[0])
    assert found.start_regret == [0.0]
    assert found.longest_stall_s == [0.0]
    assert found.fluidity == [1.0]


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.floats(0.3, 4.0))
def test_fluidity_agrees_with_etalons_algorithm(seed: int, n_skills: int, rho: float) -> None:
    plans = draw(seed, n_skills, 2, rho, 3)
    stall_s = stalls(policy("naive").schedule(plans))
    found = fluidity(stall_s, plans.nominal_s, 0.02)
    for i in range(3):
        assert found[i] == plain.fluidity(stall_s[:, i].tolist(), plans.nominal_s[:, i].tolist(), 0.02)
