"""Evaluating without schedules agrees with scheduling and measuring."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.evaluate import evaluate
from s2a_bench.policy import policy
from s2a_bench.policy.metrics import measure
from s2a_bench.policy.schedule import BLOCK
from s2a_bench.testing.policy import draw
from tests.policy import plain


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 12),
    st.floats(0.2, 3.0),
    st.sampled_from([1e-6, 0.02, 0.3]),
)
def test_it_agrees_with_the_policies_and_their_metrics(seed: int, n_skills: int, rho: float, tolerance: float) -> None:
    plans = draw(seed, n_skills, 3, rho, 7)
    found = evaluate(plans.arrival_s, plans.nominal_s, tolerance)
    for name, start_s, end_s in (
        ("naive", found.naive_start_s, found.end_s),
        ("wait-then-act", found.wait_start_s, found.wait_end_s),
        ("s2a-clairvoyant", found.safe_start_s, found.end_s),
    ):
        measured = measure(plans, policy(name).schedule(plans), tolerance_s=tolerance)
        np.testing.assert_allclose(start_s, measured.first_action_s, rtol=0, atol=1e-12)
        np.testing.assert_allclose(end_s, measured.end_s, rtol=1e-13)
        stalls = (
            (found.naive_stalls, found.naive_stall_s, found.naive_longest_stall_s) if name == "naive" else (0, 0, 0)
        )
        np.testing.assert_array_equal(stalls[0], measured.stalls)
        np.testing.assert_allclose(stalls[1], measured.stall_s, rtol=0, atol=1e-11)
        np.testing.assert_allclose(stalls[2], measured.longest_stall_s, rtol=0, atol=1e-11)


def test_it_agrees_with_the_plain_loop_on_more_plans_than_fit_a_block() -> None:
    rng = np.random.default_rng(11)
    arrival_s = np.cumsum(rng.uniform(0, 2, (4, BLOCK + 2)), axis=0)
    duration_s = rng.uniform(0.2, 1.5, arrival_s.shape)
    found = evaluate(arrival_s, duration_s)
    for column in (0, BLOCK - 1, BLOCK, BLOCK + 1):
        t, d = arrival_s[:, column].tolist(), duration_s[:, column].tolist()
        stall = plain.stalls(plain.execute(t, d, t[0]), d)
        assert found.safe_start_s[column] == pytest.approx(plain.safe_start(t, d))
        assert found.naive_stalls[column] == sum(x > 0.02 for x in stall)
        assert found.naive_stall_s[column] == pytest.approx(sum(stall))
        assert found.naive_longest_stall_s[column] == pytest.approx(max(stall))
        assert found.wait_end_s[column] == pytest.approx(t[-1] + sum(d))


def test_plans_of_hundreds_of_skills_count_every_stall() -> None:
    arrival_s = np.arange(1.0, 701.0)[:, np.newaxis]
    found = evaluate(arrival_s, np.full((700, 1), 0.5))
    assert found.naive_stalls.tolist() == [699]
    assert found.naive_stall_s == pytest.approx(699 * 0.5)


def test_a_stall_as_long_as_the_tolerance_does_not_count() -> None:
    arrival_s = np.array([[0.0], [1.25], [2.75]])
    assert evaluate(arrival_s, np.ones((3, 1)), 0.25).naive_stalls == [1]
