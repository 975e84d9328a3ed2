"""What is true of start times and schedules (shared POLICY page, section 2), on any plan."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import BLOCK, elastic, hold, least_end, safe_start, work_conserving
from tests.conftest import examples
from tests.policy import plain

EXACT = 1e-9
many = settings(max_examples=examples(200))

sixteenths = st.integers(0, 64).map(lambda n: n / 16)
"""Sums of them are exact, so that hypothesis may look for ties."""


@st.composite
def elastic_plans(draw: st.DrawFn, most_skills: int = 8) -> Plans:
    """Draw one plan, (N, 1): any arrivals, T_min <= T_nom <= T_max."""
    n = draw(st.integers(1, most_skills))
    column = st.lists(sixteenths, min_size=n, max_size=n)
    arrival, least = np.cumsum(draw(column)), np.array(draw(column))
    nominal = least + np.array(draw(column))
    most = nominal + np.array(draw(column))
    return Plans(*(values[:, np.newaxis] for values in (arrival, nominal, least, most)))


def total(values: np.ndarray) -> float:
    return float(values.sum())


@many
@given(elastic_plans())
def test_the_arrays_agree_with_the_plain_loop(plans: Plans) -> None:
    t, nominal, least, most = (
        values[:, 0].tolist() for values in (plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s)
    )
    for durations in (nominal, least, most):
        column = np.array(durations)[:, np.newaxis]
        first = safe_start(plans.arrival_s, column)
        assert first.tolist() == [plain.safe_start(t, durations)]
        for begin in (0.0, t[0], t[-1], first[0]):
            starts = work_conserving(plans.arrival_s, column, begin)
            assert starts[:, 0].tolist() == plain.execute(t, durations, begin)
    starts = work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[0])
    assert stalls(Schedule(starts, plans.nominal_s))[:, 0].tolist() == plain.stalls(starts[:, 0].tolist(), nominal)
    held = hold(plans.arrival_s, starts, plans.nominal_s, plans.most_s)
    assert held[:, 0].tolist() == plain.held(t, starts[:, 0].tolist(), nominal, most)


def test_more_plans_than_fit_a_chunk_are_the_same_plans() -> None:
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0, 2, (5, BLOCK + 3)), axis=0)
    least = rng.uniform(0, 1, t.shape)
    plans = Plans(t, least, least, least + rng.uniform(0, 1, t.shape))
    schedule, first = elastic(plans), safe_start(t, least)
    for column in (0, BLOCK - 1, BLOCK, BLOCK + 2):
        cut = slice(column, column + 1)
        alone = elastic(Plans(t[:, cut], least[:, cut], least[:, cut], plans.most_s[:, cut]))
        assert alone.start_s[:, 0].tolist() == schedule.start_s[:, column].tolist()
        assert alone.duration_s[:, 0].tolist() == schedule.duration_s[:, column].tolist()
        assert plain.safe_start(t[:, column].tolist(), least[:, column].tolist()) == pytest.approx(first[column])


def test_one_column_stands_for_all_plans() -> None:
    t = np.array([[0.0, 1.0], [3.0, 1.5]])
    assert safe_start(t, np.ones((2, 1))).tolist() == [2.0, 1.0]
    assert work_conserving(t, np.ones((2, 1)), t[0]).tolist() == [[0.0, 1.0], [3.0, 2.0]]
    assert safe_start(t[:, :1], np.array([[1.0, 2.0], [1.0, 1.0]])).tolist() == [2.0, 1.0]


@many
@given(elastic_plans(), sixteenths)
def test_t1_idling_is_conserved_whenever_execution_starts(plans: Plans, delay: float) -> None:
    safe, naive = float(safe_start(plans.arrival_s, plans.nominal_s)[0]), float(plans.arrival_s[0, 0])
    for first in (naive, safe, naive + delay):
        starts = work_conserving(plans.arrival_s, plans.nominal_s, first)
        assert total(stalls(Schedule(starts, plans.nominal_s))) == max(0.0, safe - first)
        assert starts[-1, 0] + plans.nominal_s[-1, 0] == max(first, safe) + total(plans.nominal_s)


@many
@given(elastic_plans())
def test_t2_the_elastic_schedule_never_stalls_and_attains_the_least_start_and_the_least_end(plans: Plans) -> None:
    schedule = elastic(plans)
    assert (schedule.start_s >= plans.arrival_s).all()
    assert (schedule.start_s[1:] == schedule.start_s[:-1] + schedule.duration_s[:-1]).all()
    assert (schedule.duration_s >= plans.least_s).all()
    assert (schedule.duration_s <= plans.most_s).all()
    assert schedule.start_s[0] == safe_start(plans.arrival_s, plans.most_s)
    assert schedule.start_s[-1] + schedule.duration_s[-1] == least_end(plans.arrival_s, plans.least_s)


@given(elastic_plans(6), st.randoms(use_true_random=False))
def test_t2_a_linear_program_finds_nothing_less_in_any_component(plans: Plans, random: object) -> None:
    n = len(plans.arrival_s)
    weights = np.array([random.uniform(0.1, 1.0) for _ in range(n)])  # type: ignore[attr-defined]
    step = np.zeros((n - 1, n))
    step[range(n - 1), range(n - 1)], step[range(n - 1), range(1, n)] = -1, 1  # s_{i+1} - s_i
    found = linprog(
        weights,
        A_ub=np.vstack([step, -step]) if n > 1 else None,
        b_ub=np.concatenate([plans.most_s[:-1, 0], -plans.least_s[:-1, 0]]) if n > 1 else None,
        bounds=[(t, None) for t in plans.arrival_s[:, 0]],
    )
    assert found.status == 0
    # A schedule that is least in every component is the minimum whatever the weights.
    assert elastic(plans).start_s[:, 0] == pytest.approx(found.x, abs=1e-7)


@many
@given(elastic_plans())
def test_t3_stretching_alone_costs_no_completion_time(plans: Plans) -> None:
    schedule = elastic(Plans(plans.arrival_s, plans.nominal_s, plans.nominal_s, plans.most_s))
    assert schedule.start_s[0] == safe_start(plans.arrival_s, plans.most_s)
    end = safe_start(plans.arrival_s, plans.nominal_s) + total(plans.nominal_s)
    assert schedule.start_s[-1] + schedule.duration_s[-1] == end


def test_t4_holding_only_at_the_end_of_a_skill_stalls_where_stretching_ahead_does_not() -> None:
    column = np.ones((3, 1))
    plans = Plans(np.array([[0.0], [0.0], [4.0]]), column, column, 2 * column)
    first = safe_start(plans.arrival_s, plans.most_s)
    assert first == [0.0]  # before the paper's start
    assert safe_start(plans.arrival_s, plans.nominal_s) == [2.0]
    starts = work_conserving(plans.arrival_s, plans.nominal_s, first)
    held = Schedule(starts, hold(plans.arrival_s, starts, plans.nominal_s, plans.most_s))
    assert held.duration_s[:, 0].tolist() == [1.0, 2.0, 1.0]
    assert stalls(held)[:, 0].tolist() == [0.0, 1.0]
    planned = elastic(plans)
    assert planned.start_s[:, 0].tolist() == [0.0, 2.0, 4.0]
    assert total(stalls(planned)) == 0


@many
@given(elastic_plans(), st.lists(st.integers(0, 16), min_size=8, max_size=8))
def test_t5_the_start_for_least_durations_is_safe_however_early_skills_finish(plans: Plans, early: list[int]) -> None:
    part = np.array(early[: len(plans.arrival_s)])[:, np.newaxis] / 16
    actual = plans.least_s + part * (plans.nominal_s - plans.least_s)
    first = safe_start(plans.arrival_s, plans.least_s)
    assert first >= safe_start(plans.arrival_s, plans.nominal_s)
    starts = work_conserving(plans.arrival_s, actual, first)
    assert total(stalls(Schedule(starts, actual))) <= EXACT


@many
@given(elastic_plans())
def test_t5_the_papers_start_stalls_by_the_difference_when_all_skills_finish_early(plans: Plans) -> None:
    papers, safe = (float(safe_start(plans.arrival_s, d)[0]) for d in (plans.nominal_s, plans.least_s))
    starts = work_conserving(plans.arrival_s, plans.least_s, papers)
    assert total(stalls(Schedule(starts, plans.least_s))) == safe - papers


@many
@given(elastic_plans())
def test_t7_the_pre_roll_is_the_highest_point_of_the_walk_of_gaps_minus_durations(plans: Plans) -> None:
    steps = np.diff(plans.arrival_s[:, 0]) - plans.nominal_s[:-1, 0]
    highest = max([0.0, *np.cumsum(steps).tolist()])
    assert safe_start(plans.arrival_s, plans.nominal_s)[0] - plans.arrival_s[0, 0] == highest


@given(st.integers(1, 8), st.integers(1, 400), st.integers(1, 80), st.integers(2, 32))
def test_uniform_arrivals_are_stall_free_exactly_if_a_gap_fits_a_skill(
    length: int, tenths: int, twentieths: int, n: int
) -> None:
    arrival_s = uniform(0.5, length, tenths / 10, n)
    free = safe_start(arrival_s, np.full((n, 1), twentieths / 20)) - arrival_s[0] <= EXACT
    assert free.tolist() == [length * 200 <= tenths * twentieths]  # L / R <= T, in whole numbers


@pytest.mark.parametrize("n_skills", [1, 2, 8, 32])
@pytest.mark.parametrize("rho", [0.1, 0.5, 1.0, 1.5, 7.0])
def test_stream_to_act_starts_before_wait_by_n_minus_1_times_the_shorter_of_gap_and_skill(
    n_skills: int, rho: float
) -> None:
    arrival_s = uniform(0.4, 3, 3 / (rho * 2.0), n_skills)
    gain = arrival_s[-1] - safe_start(arrival_s, np.full((n_skills, 1), 2.0))
    assert gain == pytest.approx((n_skills - 1) * min(rho * 2.0, 2.0))


@pytest.mark.parametrize("n_skills", [1, 2, 8, 32])
def test_completion_speeds_up_by_at_most_2n_over_n_plus_1_and_most_at_rho_1(n_skills: int) -> None:
    rho = np.array([0.01, 0.3, 0.9, 0.99, 1.0, 1.01, 1.1, 3.0, 100.0])
    arrival_s = uniform(0.0, 1.0, 1 / rho, n_skills)
    streamed = safe_start(arrival_s, np.ones((n_skills, 1))) + n_skills
    speed_up = (arrival_s[-1] + n_skills) / streamed
    assert speed_up.max() == pytest.approx(2 * n_skills / (n_skills + 1))
    assert n_skills == 1 or rho[speed_up.argmax()] == 1.0
