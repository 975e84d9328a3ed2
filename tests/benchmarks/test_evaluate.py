"""Evaluating without schedules agrees with scheduling and measuring."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.evaluate import evaluate
from s2a_bench.policy import policy
from s2a_bench.policy.metrics import measure
from s2a_bench.testing.policy import draw


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
