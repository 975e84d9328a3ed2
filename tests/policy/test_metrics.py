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


BY_HAND = {
    "first_action_s": (1.0, 5.0),
    "end_s": (7.0, 9.0),
    "stalls": (1, 0),
    "stall_s": (2.0, 0.0),
    "longest_stall_s": (2.0, 0.0),
    "stall_ratio": (2 / 6, 0.0),
    "start_regret": (0.0, 2 / 3),
    "signed_start_regret": (-2 / 3, 2 / 3),
    "start_regret_elastic": (0.0, 3 / 2),
    "too_early_s": (1.0, 0.0),
    "start_regret_of_wait": (0.0, 1.0),
    "end_regret": (0.0, 2 / 7),
    "end_regret_of_wait": (0.0, 1.0),
    "end_regret_elastic": (1.5 / 5.5, 3.5 / 5.5),
    "mean_queue_wait_s": (1 / 3, (4 + 2 + 3) / 3),  # naive: the third skill lies ready from 5 to 6
    "longest_queue_wait_s": (1.0, 4.0),
    "mean_action_age_s": ((1 + 4 + 6) / 3, (5 + 6 + 8) / 3),
    "oldest_action_s": (6.0, 8.0),
    "speed_distortion": (1.0, 1.0),
    "fluidity": (2 / 5, 1.0),  # two met; 2 s late on a budget of 1 s misses three
}
"""Metric -> of naive, of wait-then-act."""


def test_every_metric_is_what_it_is_by_hand() -> None:
    both = [measure(PLANS, policy(name).schedule(PLANS)) for name in ("naive", "wait-then-act")]
    assert {field.name for field in fields(PlanMetrics)} == set(BY_HAND)
    for name, values in BY_HAND.items():
        assert [getattr(each, name)[0] for each in both] == pytest.approx(values), name


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


def test_a_stall_up_to_the_tolerance_counts_in_the_total_only() -> None:
    schedule = Schedule(column(0.0, 1.015625, 2.25), column(1.0, 1.0, 1.0))
    for tolerance_s, count, fluent in ((0.02, 1, 2 / 3), (0.015625, 1, 2 / 3), (1e-6, 2, 1 / 3)):
        found = measure(PLANS, schedule, tolerance_s=tolerance_s)
        assert (found.stalls, found.stall_s) == ([count], [0.25])
        assert found.fluidity == [fluent]


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
