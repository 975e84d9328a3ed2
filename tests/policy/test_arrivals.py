"""When fragments arrive, and the plans that they make."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.boards.gaps import Constant, Lognormal
from s2a_bench.policy import PlanShape, Timing
from s2a_bench.policy.arrivals import fragments, recorded_plans, tokens, uniform


def test_uniform_fragments_come_every_l_over_r_seconds_after_the_prompt_of_each_plan() -> None:
    assert uniform(0.5, 6, 4.8, 3).tolist() == [[1.75], [3.0], [4.25]]
    assert uniform([0.0, 1.0], [2, 6], [4.0, 3.0], 2).tolist() == [[0.5, 3.0], [1.0, 5.0]]


def test_the_first_token_comes_one_gap_after_the_prompt_of_each_plan() -> None:
    at_s = tokens(Constant(0.25), np.array([3.0, 5.0]), 4, 2, np.random.default_rng(0))
    assert at_s.tolist() == [[3.25, 5.25], [3.5, 5.5], [3.75, 5.75], [4.0, 6.0]]
    assert fragments(at_s, 2).tolist() == [[3.5, 5.5], [4.0, 6.0]]


def test_random_tokens_are_the_running_sum_of_the_familys_gaps() -> None:
    gaps = Lognormal(0.2, 0.4)
    at_s = tokens(gaps, 0.5, 60, 9, np.random.default_rng(8))
    expected = 0.5 + np.cumsum(gaps.sample(np.random.default_rng(8), 60, 9), axis=0)
    assert at_s == pytest.approx(expected, rel=1e-13)


def test_recorded_answers_become_plans_and_short_ones_are_left_out() -> None:
    shape, rng = PlanShape(3, 2, Timing(1.0, 0.8, 1.5), 0.2), np.random.default_rng(0)
    plans = recorded_plans([np.arange(1.0, 9), np.arange(5.0), np.arange(2.0, 8)], shape, rng)
    assert plans.token_s is not None
    np.testing.assert_array_equal(plans.token_s.T, [np.arange(1.0, 7), np.arange(2.0, 8)])
    np.testing.assert_array_equal(plans.arrival_s.T, [[2, 4, 6], [3, 5, 7]])
    assert recorded_plans([np.arange(2.0)], shape, rng).arrival_s.shape == (3, 0)
