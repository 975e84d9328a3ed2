"""Where naive never stalls: the closed form, at drawn and at even arrivals."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.policy import policy as build
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.metrics import measure
from s2a_bench.policy.schedule import safe_start
from s2a_bench.testing.policy import draw


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.floats(0.2, 1.6))
def test_naive_is_stall_free_exactly_if_the_safe_start_is_the_first_arrival(seed: int, n: int, rho: float) -> None:
    plans = draw(seed, n, 2, rho, 20, gap_cv=0.2)
    measured = measure(plans, build("naive").schedule(plans), tolerance_s=1e-9)
    free = safe_start(plans.arrival_s, plans.nominal_s) - plans.arrival_s[0] <= 1e-9
    assert free.tolist() == (measured.stalls == 0).tolist()


@given(st.integers(1, 8), st.integers(1, 400), st.integers(1, 80), st.integers(2, 32))
def test_uniform_arrivals_are_stall_free_exactly_if_a_gap_fits_a_skill(
    length: int, tenths: int, twentieths: int, n: int
) -> None:
    rate, duration_s = tenths / 10, twentieths / 20
    arrival_s = uniform(0.5, length, rate, n)
    free = safe_start(arrival_s, np.full((n, 1), duration_s)) - arrival_s[0] <= 1e-9
    assert free.tolist() == [length * 200 <= tenths * twentieths]  # L / R <= T, in whole numbers
