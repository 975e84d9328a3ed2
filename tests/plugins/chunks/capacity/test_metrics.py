"""The metrics of a fleet, by hand, and the interval of its stalled share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace, cycle_ns, measures, share_interval
from s2a_bench.plugins.chunks.modes import ControlSetting, Ticks

MS = 1_000_000
SETTING = ControlSetting(20 * MS, 4)
CHUNK = [-1, 0, 0, -1, 1, 1, 2, 2]


def trace(
    robot: int = 0, start_ns: int = 0, chunk: Any = CHUNK, arrival_ms: Any = (15, 30, -1), **more: Any
) -> RobotTrace:
    executed = np.array(chunk)
    age = np.where(executed < 0, -1, np.arange(executed.size) % 3)
    ticks = Ticks(executed, executed, age, executed < -1)
    arrival_ns = np.array(arrival_ms) * MS
    request_ns = start_ns + np.array([0, 60, 100][: arrival_ns.size]) * MS
    return RobotTrace(robot, start_ns, start_ns + 160 * MS, request_ns, arrival_ns, ticks, **more)


def test_a_fleet_by_hand() -> None:
    late_ns = np.arange(8) * MS
    first_ns = np.array([5, 10, -1]) * MS
    slow = trace(1, arrival_ms=(45, 90, -1), chunk=[-1, -1, -1, 0, 0, 0, 1, 1])
    found = measures([trace(first_ns=first_ns, late_ns=late_ns), slow], SETTING)
    assert found.requests_per_s == pytest.approx(4 / 0.16)
    assert found.latency_mean_ns == 45 * MS
    assert found.latency_p50_ns == 37.5 * MS
    assert found.unfair == pytest.approx(67.5 / 45)
    assert found.stalled == 5 / 16, "before the first action, too"
    assert found.stalled_worst == 3 / 8
    assert found.in_time == 2 / 3, "of three chunks that took over from another, one came late"
    assert found.late_p99_ns == round(np.quantile(late_ns, 0.99))
    assert found.age_p99_ns == 40 * MS


def test_what_comes_before_a_fleet_has_settled_is_left_out() -> None:
    found = measures([trace(), trace(1)], SETTING, settle_ns=80 * MS)
    assert found.stalled == 0
    assert found.in_time == 0.5, "the chunk that ends a stall came late"
    assert found.latency_mean_ns is None
    assert found.requests_per_s == pytest.approx(2 / 0.08), "asked before, answered after"


def test_requests_before_a_fleet_has_settled_or_never_made_say_nothing_of_the_generator() -> None:
    request_ns, late_ns = np.arange(10) * 100 * MS, np.array([50, 50, 1, 1, 1, 1, 1, -1, -1, -1]) * MS
    plain = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS), late_ns=late_ns)
    assert measures([plain], SETTING, settle_ns=200 * MS).late_p99_ns == MS


def test_a_fleet_is_the_same_whenever_it_starts_and_its_robots_in_any_order() -> None:
    late_ns, first_ns = np.arange(8) * MS, np.array([5, 10, -1]) * MS
    fleet = [
        trace(0, first_ns=first_ns, late_ns=late_ns),
        trace(1, 7 * MS, arrival_ms=(45, 90, -1), late_ns=late_ns[::-1]),
        trace(2, 3 * MS, chunk=[-1, -1, 0, 0, 0, 0, -1, 1]),
    ]
    for settle_ns in (0, 50 * MS, 80 * MS):
        found = measures(fleet, SETTING, settle_ns)
        moved = [each.shifted(12_345_678_901) for each in (fleet[2], fleet[0], fleet[1])]
        assert vars(measures(moved, SETTING, settle_ns)) == pytest.approx(vars(found), nan_ok=True)


def test_robots_without_an_action_are_neither_in_time_nor_late() -> None:
    idle = trace(0, chunk=[-1] * 8, arrival_ms=())
    found = measures([idle], SETTING)
    assert (found.stalled, found.in_time, found.age_p50_ns, found.latency_p50_ns) == (1, None, None, None)
    assert measures([idle, trace(1)], SETTING).in_time == measures([trace(1)], SETTING).in_time


def test_every_episode_has_its_own_start() -> None:
    episodes = [trace(robot, start_ns) for start_ns in (0, 10**9) for robot in (0, 1)]
    assert measures(episodes, SETTING).requests_per_s == pytest.approx(8 / 0.32)
    assert measures(episodes, SETTING, settle_ns=80 * MS).stalled == 0


def test_answers_a_second_are_those_while_all_robots_act() -> None:
    """From 80 ms, the start of the second, to 160 ms, the end of the first: at 90 and 95 ms, of 15, 90, 95 and 170."""
    assert measures([trace(), trace(1, 80 * MS)], SETTING).requests_per_s == pytest.approx(2 / 0.08)


def test_robots_without_a_clock_have_neither_ticks_nor_ages() -> None:
    request_ns = np.arange(10) * 100 * MS
    plain = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS))
    found = measures([plain], SETTING)
    assert (found.requests_per_s, found.latency_p99_ns, found.unfair) == (10, 60 * MS, 1)
    assert (found.stalled, found.age_p50_ns, found.in_time, found.ttft_p99_ns) == (None,) * 4
    plans = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS), plan_stalled=np.arange(10) < 3)
    assert measures([plans], SETTING).stalled == 0.3


def interval(stalled: Any, robots: int = 1, cycle: float = 1, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval of flags, a tick each ns; robots have a row each."""
    flags = np.asarray(stalled, bool).reshape(robots, -1)
    at_ns = np.broadcast_to(np.arange(flags.shape[1]), flags.shape).ravel()
    return share_interval(flags.ravel(), at_ns, np.repeat(np.arange(robots), flags.shape[1]), cycle, confidence)


@pytest.mark.parametrize(
    ("robots", "cycle", "unseen"),
    [(1, 1, 2.5), (1, 16, 2.5), (1, 160, 25), (8, 16, 20)],
    ids=["one value", "a sixteenth is one value", "a sixteenth of a cycle", "of each robot"],
)
def test_without_a_stall_the_share_is_below_that_of_events_that_were_not_seen(
    robots: int, cycle: float, unseen: float
) -> None:
    """No event is seen of -ln(0.025) that are expected in one run of forty."""
    high = -np.log(0.025) * unseen / (1000 * robots)
    assert interval(np.zeros(1000 * robots), robots, cycle) == pytest.approx((0, high))
    assert interval(np.ones(1000 * robots), robots, cycle) == pytest.approx((1 - high, 1))


def by_chi_square(hits: float, variance: float, unseen: float) -> tuple[float, float]:
    """Return the interval of a number of stalls as Fay and Feuer write it; one event of ``unseen`` more is possible."""
    more, upper = hits + unseen, variance + unseen**2
    low = variance / (2 * hits) * stats.chi2.ppf(0.025, 2 * hits**2 / variance)
    return low, upper / (2 * more) * stats.chi2.ppf(0.975, 2 * more**2 / upper)


def student(freedom: int) -> float:
    """Return the factor by which so few degrees of freedom enlarge a variance."""
    return float(stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)) ** 2


def test_four_times_have_the_interval_of_a_sum_of_events_of_unlike_size() -> None:
    """Events of 2 and 1 are seen, and one of 5 is not."""
    flags = np.zeros((4, 20), bool)
    flags[:2, 0] = flags[3, 10] = True
    at_ns, robots = np.tile(np.arange(20) // 5, 4), np.repeat(np.arange(4), 20)
    low, high = by_chi_square(3, 5, unseen=5)
    assert share_interval(flags.ravel(), at_ns, robots, 1) == pytest.approx((low / 80, high / 80))


def test_what_is_within_a_cycle_is_one_event() -> None:
    """One event of 4 has one degree of freedom; four of 1 a cycle apart have three, and the next may be of 2.5."""
    together, apart = np.zeros(1000), np.zeros(1000)
    together[500:504] = 1
    apart[[100, 300, 500, 700]] = 1
    for flags, freedom, unseen in ((together, 1, 10), (apart, 3, 2.5)):
        blocks = flags.reshape(5, 200).sum(axis=1)
        low, high = by_chi_square(4, 5 * blocks.var(ddof=1) * student(freedom), unseen)
        assert interval(flags, cycle=4) == pytest.approx((low / 1000, high / 1000))


def test_robots_that_differ_have_the_variance_between_them() -> None:
    """Of six one has all stalls, 10, a cycle apart: five degrees of freedom, and the next may be of 3.75."""
    flags = np.zeros((6, 1000))
    flags[0, 50::100] = 1
    variance = 6 / 5 * ((10 - 10 / 6) ** 2 + 5 * (10 / 6) ** 2)
    low, high = by_chi_square(10, variance * student(5), unseen=3.75)
    assert interval(flags, 6, cycle=4) == pytest.approx((low / 6000, high / 6000))


@pytest.mark.parametrize("expected", [0.3, 1, 3, 10, 40])
@pytest.mark.parametrize("confidence", [0.95, 0.99])
def test_the_interval_holds_the_share_of_few_events_of_unlike_size(expected: float, confidence: float) -> None:
    """Events of 1 to 40 ticks of eight robots, as a queue makes them: 20 s, and a request each 0.32 s."""
    rng, runs, sizes = np.random.default_rng(1), 30, np.array([1, 2, 4, 8, 16, 40])
    chances = np.array([0.3, 0.25, 0.2, 0.12, 0.1, 0.03])
    share = expected * float(sizes @ chances) / 8000
    held = 0
    for _ in range(runs):
        stalled = np.zeros((1000, 8), bool)
        for size in rng.choice(sizes, rng.poisson(expected), p=chances):
            stalled.reshape(-1)[(start := 8 * rng.integers(0, 994)) : start + size] = True
        low, high = interval(stalled.T, 8, cycle=16, confidence=confidence)
        held += low <= share <= high
    assert stats.binom.cdf(held, runs, confidence) > 0.01, "so few of the runs would be chance once in a hundred times"


def test_a_cycle_is_the_time_between_two_requests_of_a_robot() -> None:
    assert cycle_ns([trace(), trace(1, arrival_ms=(15,))]) == 320 * MS / 4
    assert cycle_ns([trace(arrival_ms=())]) == 160 * MS
