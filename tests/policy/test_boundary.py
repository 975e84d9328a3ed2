"""The stall-free region: its lines, its simulation, and that both are the same where there is no jitter."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.boards.gaps import Constant, Lognormal
from s2a_bench.policy import Plans
from s2a_bench.policy import policy as build
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.evaluate import Grid, analytic, evaluate, simulate
from s2a_bench.policy.metrics import measure
from s2a_bench.testing.policy import draw

GRID = Grid((1, 2, 4, 6), (0.58, 2.0, 3.1, 4.8, 6.5, 34.2))


def p_stall(cv: float, grid: Grid = GRID, plans: int = 400, seed: int = 1) -> np.ndarray:
    gaps = Lognormal(0.2, cv) if cv else Constant(0.2)
    return simulate(grid, gaps, n_skills=8, duration_s=1.0, plans=plans, rng=np.random.default_rng(seed))


def test_the_line_is_tokens_over_duration() -> None:
    assert analytic(Grid((2, 4), (2.49, 2.5, 4.99, 5.0)), 0.8).tolist() == [
        [False, True, True, True],
        [False] * 3 + [True],
    ]


def test_the_papers_line_leaves_out_what_runs_smoothly_at_nominal_durations() -> None:
    papers, true = analytic(GRID, 0.8), analytic(GRID, 1.0)
    assert (true >= papers).all()
    assert true[2, 3]  # 4 tokens at 4.8 tokens/s: 0.83 s a skill
    assert not papers[2, 3]


def test_without_jitter_the_simulation_is_the_analytic_region() -> None:
    assert ((p_stall(0.0) == 0) == analytic(GRID, 1.0)).all()
    assert set(np.unique(p_stall(0.0))) == {0.0, 1.0}


def test_jitter_blurs_the_boundary_and_leaves_the_far_ends() -> None:
    share = p_stall(0.5)
    assert share[3, 0] == 1.0
    assert share[0, -1] == 0.0
    assert 0.05 < share[2, 3] < 0.95


def test_more_tokens_a_skill_or_a_lower_rate_never_stall_less() -> None:
    grid = Grid((4,), tuple(np.linspace(3.0, 8.0, 30)))
    assert (np.diff(p_stall(0.3, grid)[0]) <= 0).all()


def test_a_seed_makes_the_simulation_repeat_itself() -> None:
    assert p_stall(0.5, seed=3).tolist() == p_stall(0.5, seed=3).tolist()
    assert p_stall(0.5, seed=3).tolist() != p_stall(0.5, seed=4).tolist()


def test_the_simulated_share_is_that_of_naive_timelines_over_the_same_gaps() -> None:
    rng = np.random.default_rng(1)
    arrival_s = np.cumsum(Lognormal(1 / 4.8, 0.5).sample(rng, 6 * 8, 400), axis=0)[3 : 4 * 8 : 4]
    ones = np.ones_like(arrival_s)
    plans = Plans(arrival_s, ones, ones, ones)
    stalled = measure(plans, build("naive").schedule(plans)).stalls > 0
    assert p_stall(0.5)[2, 3] == stalled.mean()


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.floats(0.2, 1.6))
def test_naive_is_stall_free_exactly_if_the_safe_start_is_the_first_arrival(seed: int, n: int, rho: float) -> None:
    plans = draw(seed, n, 2, rho, 20, gap_cv=0.2)
    measured = measure(plans, build("naive").schedule(plans), tolerance_s=1e-9)
    free = evaluate(plans.arrival_s, plans.nominal_s).naive_stall_s <= 1e-9
    assert free.tolist() == (measured.stalls == 0).tolist()


@settings(deadline=None, max_examples=80)
@given(st.integers(1, 8), st.integers(1, 400), st.integers(1, 80), st.integers(2, 32))
def test_uniform_arrivals_are_stall_free_exactly_if_a_gap_fits_a_skill(
    length: int, tenths: int, twentieths: int, n: int
) -> None:
    rate, duration_s = tenths / 10, twentieths / 20
    free = evaluate(uniform(0.5, length, rate, n), np.full((n, 1), duration_s)).naive_stall_s <= 1e-9
    assert free.tolist() == [length * 200 <= tenths * twentieths]  # L / R <= T, in whole numbers
