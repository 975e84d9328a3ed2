"""The metrics of a fleet, by hand, and the interval of its stalled share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from s2a_bench.experiments.capacity.metrics import RobotTrace, measures, share_interval
from s2a_bench.policy.chunks import ControlSetting, Ticks

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
    assert found["requests_per_s"] == pytest.approx(4 / 0.16)
    assert found["latency_mean_ns"] == 45 * MS
    assert found["latency_p50_ns"] == 37.5 * MS
    assert found["unfair"] == pytest.approx(67.5 / 45)
    assert found["stalled"] == 5 / 16, "before the first action, too"
    assert found["stalled_worst"] == 3 / 8
    assert found["in_time"] == 2 / 3, "of three chunks that took over from another, one came late"
    assert found["late_p99_ns"] == round(np.quantile(late_ns, 0.99))
    assert found["age_p99_ns"] == 40 * MS


def test_what_comes_before_a_fleet_has_settled_is_left_out() -> None:
    found = measures([trace(), trace(1)], SETTING, settle_ns=80 * MS)
    assert found["stalled"] == 0
    assert found["in_time"] == 0.5, "the chunk that ends a stall came late"
    assert found["latency_mean_ns"] is None
    assert found["requests_per_s"] == pytest.approx(2 / 0.08), "asked before, answered after"


def test_requests_before_a_fleet_has_settled_or_never_made_say_nothing_of_the_generator() -> None:
    request_ns, late_ns = np.arange(10) * 100 * MS, np.array([50, 50, 1, 1, 1, 1, 1, -1, -1, -1]) * MS
    plain = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS), late_ns=late_ns)
    assert measures([plain], SETTING, settle_ns=200 * MS)["late_p99_ns"] == MS


def test_every_episode_has_its_own_start() -> None:
    episodes = [trace(robot, start_ns) for start_ns in (0, 10**9) for robot in (0, 1)]
    assert measures(episodes, SETTING)["requests_per_s"] == pytest.approx(8 / 0.32)
    assert measures(episodes, SETTING, settle_ns=80 * MS)["stalled"] == 0


def test_robots_without_a_clock_have_neither_ticks_nor_ages() -> None:
    request_ns = np.arange(10) * 100 * MS
    plain = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS))
    found = measures([plain], SETTING)
    assert (found["requests_per_s"], found["latency_p99_ns"], found["unfair"]) == (10, 60 * MS, 1)
    assert (found["stalled"], found["age_p50_ns"], found["in_time"], found["ttft_p99_ns"]) == (None,) * 4
    plans = RobotTrace(0, 0, 10**9, request_ns, np.full(10, 60 * MS), plan_stalled=np.arange(10) < 3)
    assert measures([plans], SETTING)["stalled"] == 0.3


def interval(stalled: Any, robots: int = 1) -> tuple[float, float]:
    flags = np.asarray(stalled, bool).reshape(robots, -1)
    at_ns = np.broadcast_to(np.arange(flags.shape[1]), flags.shape).ravel()
    return share_interval(flags.ravel(), at_ns, np.repeat(np.arange(robots), flags.shape[1]))


def test_the_interval_of_independent_ticks_is_that_of_clopper_and_pearson() -> None:
    assert interval(np.zeros(1000)) == pytest.approx((0, 0.00368), abs=1e-5)
    assert interval(np.ones(1000))[1] == 1


def test_stalls_that_come_together_and_robots_that_differ_widen_the_interval() -> None:
    rng = np.random.default_rng(0)
    apart = rng.random(10_000) < 0.1
    together = np.repeat(rng.random(100) < 0.1, 100)
    unlike = rng.random((10, 1000)) < np.linspace(0, 0.2, 10)[:, np.newaxis]
    widths = [high - low for low, high in (interval(apart), interval(together), interval(unlike, 10))]
    assert widths[0] < 0.03
    assert min(widths[1:]) > 0.06


def test_the_interval_covers_the_share_of_correlated_stalls() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(200):
        stalled = np.repeat(rng.random((8, 100)) < 0.05, 20, axis=1)
        low, high = interval(stalled, 8)
        covered += low <= 0.05 <= high
    assert covered >= 180
