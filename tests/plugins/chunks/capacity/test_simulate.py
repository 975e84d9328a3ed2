"""A fleet in virtual time does what an obvious second simulation does, and has the known forms."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import repeat
from typing import Any

import numpy as np
import pytest

from s2a_bench.plugins.chunks.capacity.config import RobotLoad
from s2a_bench.plugins.chunks.capacity.metrics import FleetMetrics, measures
from s2a_bench.plugins.chunks.capacity.simulate import ServiceTime, robot_of, serve, simulate
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode, mode

MS = 1_000_000
DT = 20 * MS
PLAIN = (1.0,)


def constant(service_ns: int) -> Iterator[ServiceTime]:
    return repeat(ServiceTime(service_ns, service_ns))


def exponential(mean_ns: float, seed: int = 0) -> Iterator[ServiceTime]:
    for each in np.random.default_rng(seed).exponential(mean_ns, 200_000).astype(int).tolist():
        yield ServiceTime(each, each)


def fleet(
    written: str = "", seconds: float = 60, horizon: int = 16, rounding: Any = "floor", **given: Any
) -> tuple[RobotLoad, int]:
    """Return what each robot does, and for how long."""
    setting = ControlSetting(given.pop("period_ns", DT), horizon, rounding)
    return RobotLoad(setting, mode(written) if written else None, **given), round(seconds * 1e9)


def measured(
    fleet: tuple[RobotLoad, int],
    robots: int,
    times: Iterator[ServiceTime],
    settle_s: float = 30,
    servers: int = 1,
    batch: Any = PLAIN,
) -> FleetMetrics:
    traces = simulate(*fleet, robots, times, np.random.default_rng(1), servers, batch)
    return measures(traces, fleet[0].setting, round(settle_s * 1e9))


class TickByTick:
    """The same fleet, one boundary of ticks after another."""

    def __init__(
        self, made: Mode, setting: ControlSetting, starts: Sequence[int], times: Iterator[ServiceTime], slower: Any
    ) -> None:
        self.setting, self.starts, self.times, self.slower = setting, starts, times, slower
        self.steppers = [made.stepper(setting) for _ in starts]
        self.left: list[list[int]] = [[] for _ in starts]
        self.arrived: list[list[int]] = [[] for _ in starts]
        self.told = [0 for _ in starts]
        self.acts: list[list[tuple[int, int]]] = [[] for _ in starts]
        self.waiting: deque[tuple[int, int]] = deque()

    def run(self, servers: int, most: int) -> None:
        free, floor = [0] * servers, self.setting.rounding == "floor"
        for at_ns, robot, tick in sorted(
            (start + tick * DT, robot, tick) for robot, start in enumerate(self.starts) for tick in range(most + 1)
        ):
            self.work(free, at_ns)
            if floor and tick:
                self.deliver(robot, at_ns - 1, tick - 1)
                self.act(robot, tick - 1)
            if tick < most:
                self.deliver(robot, at_ns, tick)
                if self.steppers[robot].ask(tick):
                    self.left[robot].append(at_ns)
                    self.waiting.append((at_ns, robot))
            if tick < most and not floor:
                self.act(robot, tick)
        self.work(free, 2**62)

    def work(self, free: list[int], before_ns: int) -> None:
        while self.waiting:
            server = min(range(len(free)), key=free.__getitem__)
            start = max(free[server], self.waiting[0][0])
            if start >= before_ns:
                return
            size = sum(at < start or at == self.waiting[0][0] for at, _ in [*self.waiting][: len(self.slower)])
            free[server] = start + round(next(self.times).whole_ns * self.slower[size - 1])
            for _ in range(size):
                self.arrived[self.waiting.popleft()[1]].append(free[server])

    def deliver(self, robot: int, until_ns: int, tick: int) -> None:
        while self.told[robot] < len(self.arrived[robot]) and self.arrived[robot][self.told[robot]] <= until_ns:
            self.steppers[robot].arrived(self.told[robot], self.setting.horizon, tick)
            self.told[robot] += 1

    def act(self, robot: int, tick: int) -> None:
        done = self.steppers[robot].act(tick)
        self.acts[robot].append((done.request, done.index) if done else (-1, -1))


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
@pytest.mark.parametrize(
    "written",
    ["sync", "sync?execute=5", "queue?trigger=3", "queue?trigger=20", "replace", "aggregate?trigger=9", "streamed"],
)
@pytest.mark.parametrize(("servers", "slower"), [(1, PLAIN), (2, PLAIN), (1, (1.0, 1.4, 1.5))])
def test_a_fleet_does_what_its_steppers_do_tick_by_tick(
    written: str, rounding: Any, servers: int, slower: Sequence[float]
) -> None:
    made, setting, most = mode(written), ControlSetting(DT, 12, rounding), 90
    for seed in range(3):
        rng = np.random.default_rng(seed)
        starts = [0, 0, *rng.integers(0, 12 * DT, 4).tolist()]
        drawn = [ServiceTime(each, each) for each in rng.integers(1, 4 * DT, 2000).tolist()]
        robots = [robot_of(RobotLoad(setting, made), *each, most * DT) for each in enumerate(starts)]
        traces = serve(robots, iter(drawn), servers, slower)
        plainly = TickByTick(made, setting, starts, iter(drawn), slower)
        plainly.run(servers, most)
        for trace in traces:
            assert trace.request_ns.tolist() == plainly.left[trace.robot]
            assert (trace.request_ns + trace.arrival_ns).tolist() == plainly.arrived[trace.robot]
            assert list(zip(trace.ticks.chunk, trace.ticks.index, strict=True)) == plainly.acts[trace.robot]


@pytest.mark.parametrize(("robots", "think_ms", "servers"), [(1, 0, 1), (3, 50, 1), (3, 500, 1), (8, 0, 1), (9, 0, 4)])
def test_a_closed_loop_has_the_throughput_of_its_bottleneck(robots: int, think_ms: int, servers: int) -> None:
    service_s, think_s = 0.1, think_ms / 1e3
    found = measured(fleet(think_ns=think_ms * MS), robots, constant(100 * MS), servers=servers)
    rate = min(servers / service_s, robots / (think_s + service_s))
    assert found.requests_per_s == pytest.approx(rate, rel=0.01)
    assert found.latency_mean_ns / 1e9 == pytest.approx(robots / rate - think_s, rel=0.01)


def test_the_clients_of_vllm_omni_6567() -> None:
    table = {1: (6.56, 152), 2: (6.68, 297), 4: (6.71, 589), 8: (6.77, 1165)}
    for robots, (rate, latency_ms) in table.items():
        found = measured(fleet(), robots, constant(148 * MS))
        assert found.requests_per_s == pytest.approx(rate, rel=0.05)
        assert found.latency_mean_ns / MS == pytest.approx(latency_ms, rel=0.05)


def test_of_robots_that_start_together_the_last_one_waits_for_all_others_in_every_episode() -> None:
    service_ns = 7 * MS
    traces = simulate(
        *fleet("queue?trigger=8", 3, episode_ns=10**9), 12, constant(service_ns), np.random.default_rng(0), 1, PLAIN
    )
    starts = {trace.start_ns for trace in traces}
    assert starts == {0, 10**9, 2 * 10**9}
    for start_ns in starts:
        first = [(int(trace.arrival_ns[0]), trace.robot) for trace in traces if trace.start_ns == start_ns]
        assert [latency for latency, _ in sorted(first)] == [place * service_ns for place in range(1, 13)]
    orders = {tuple(trace.robot for trace in traces if trace.start_ns == start_ns) for start_ns in starts}
    assert len(orders) == 3, "each episode another robot is first"


@pytest.mark.parametrize("service_ms", [13, 20, 50, 130])
@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_one_robot_alone_stalls_as_the_closed_forms_say(service_ms: int, rounding: Any) -> None:
    delay = -(-service_ms // 20) if rounding == "ceil" else service_ms // 20
    alone = measured(fleet("sync", rounding=rounding), 1, constant(service_ms * MS))
    assert alone.stalled == pytest.approx(delay / (16 + delay), abs=2e-3)
    for trigger in (1, 4, 8):
        late = max(0, delay - trigger)
        found = measured(fleet(f"queue?trigger={trigger}", rounding=rounding), 1, constant(service_ms * MS))
        assert found.stalled == pytest.approx(late / (16 + late), abs=2e-3)


@pytest.mark.parametrize("service_ms", [20, 33, 47])
@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_a_queue_with_an_early_trigger_carries_as_many_robots_as_the_server_has_time_for(
    service_ms: int, rounding: Any
) -> None:
    trigger = -(-service_ms // 20) + 1
    knee = int(16 * 20 / (0.99 * service_ms))
    for robots in (1, knee - 1, knee, knee + 1, 2 * knee):
        found = measured(fleet(f"queue?trigger={trigger}", rounding=rounding), robots, constant(service_ms * MS))
        assert found.stalled == pytest.approx(max(0, 1 - 16 * 20 / (robots * service_ms)), abs=2e-3)
        assert (found.stalled <= 0.01) is (robots <= knee)


@pytest.mark.parametrize("written", ["sync", "queue?trigger=1"])
def test_other_modes_stall_no_less_than_the_server_s_time_and_one_robot_alone(written: str) -> None:
    alone = measured(fleet(written, rounding="ceil"), 1, constant(27 * MS)).stalled
    for robots in (2, 6, 9, 11, 12, 14, 24):
        found = measured(fleet(written, rounding="ceil"), robots, constant(27 * MS)).stalled
        assert found >= max(alone, 1 - 16 * 20 / (robots * 27)) - 2e-3
    assert found == pytest.approx(1 - 16 * 20 / (24 * 27), abs=0.01)


@pytest.mark.parametrize(
    ("written", "service_ms", "robots", "stalled", "alone"),
    [("queue?trigger=1", 20, 16, 0.029, 0.0), ("sync", 13, 23, 0.075, 0.059)],
)
def test_near_the_knee_requests_wait_for_ticks(
    written: str, service_ms: int, robots: int, stalled: float, alone: float
) -> None:
    load, span_ns = fleet(written, rounding="ceil")
    shares = []
    for seed in range(5):
        starts = np.random.default_rng(seed).integers(0, DT, robots).tolist()  # all within one tick
        clients = [robot_of(load, *each, span_ns) for each in enumerate(starts)]
        traces = serve(clients, constant(service_ms * MS))
        shares.append(measures(traces, load.setting, 30 * 10**9).stalled)
    assert np.mean(shares) == pytest.approx(stalled, abs=2e-3)
    assert measured((load, span_ns), 1, constant(service_ms * MS)).stalled == pytest.approx(alone, abs=1e-3)


def mean_value_analysis(robots: int, service_s: float, think_s: float) -> tuple[float, float]:
    """Return latency and throughput of a closed network with one exponential server (Reiser and Lavenberg 1980)."""
    queued = latency_s = rate = 0.0
    for number in range(1, robots + 1):
        latency_s = service_s * (1 + queued)
        rate = number / (think_s + latency_s)
        queued = rate * latency_s
    return latency_s, rate


@pytest.mark.parametrize("robots", [1, 4, 12])
@pytest.mark.parametrize("acting", ["closed", "sync"])
def test_exponential_service_times_have_their_mean_value_analysis(robots: int, acting: str) -> None:
    chosen = {
        "closed": fleet(seconds=1000, think_ns=160 * MS),
        "sync": fleet("sync", seconds=1000, horizon=40, rounding="ceil", period_ns=4 * MS),
    }[acting]
    found = measured(chosen, robots, exponential(40 * MS))
    latency_s, rate = mean_value_analysis(robots, 0.04, 0.16 if acting == "closed" else 0.162)
    assert found.requests_per_s == pytest.approx(rate, rel=0.02)
    assert found.latency_mean_ns / 1e9 == pytest.approx(latency_s, rel=0.03)


def test_a_batching_server_reaches_its_rate_with_a_full_batch_waiting() -> None:
    slower = np.interp(np.arange(1, 17), (1, 4, 8, 16), np.array((58.5, 100, 171.7, 324.5)) / 58.5).tolist()
    load, span_ns = fleet()
    rates = {}
    for robots in (1, 4, 8, 16, 32):
        clients = [robot_of(load, number, number * MS, span_ns) for number in range(robots)]
        traces = serve(clients, constant(58_500_000), 1, slower)
        rates[robots] = measures(traces, load.setting, 30 * 10**9).requests_per_s
    assert rates[1] == pytest.approx(17.1, rel=0.01)
    for robots in (4, 8, 16):  # one is served while the others wait, and they while it waits
        expected = robots / (0.0585 * (1 + slower[robots - 2]))
        assert rates[robots] == pytest.approx(expected, rel=0.01)
        assert expected < 0.95 * robots / (0.0585 * slower[robots - 1])
    assert rates[32] == pytest.approx(49.3, rel=0.01)


def test_what_is_spent_beside_the_server_delays_answers_and_occupies_none() -> None:
    times = repeat(ServiceTime(10 * MS, 40 * MS, 60 * MS))
    found = measured(fleet(), 5, times)
    assert found.requests_per_s == pytest.approx(25, rel=0.01)
    assert found.ttft_p50_ns == found.latency_p50_ns - 30 * MS
    assert measured(fleet(), 1, times).latency_mean_ns == 100 * MS


def test_plans_stall_when_the_server_falls_behind() -> None:
    def stalled(robots: int) -> FleetMetrics:
        return measured(fleet(every_ns=10**9), robots, constant(250 * MS))

    assert stalled(4).stalled == 0
    assert stalled(4).requests_per_s == pytest.approx(4, rel=0.01)
    assert stalled(5).stalled == 1
    assert stalled(5).latency_p50_ns > 3 * 10**9, "from when it is due, not from when the one before it has come"


def test_thousands_of_robots_are_served_by_hundreds_of_servers() -> None:
    found = measured(fleet("queue?trigger=8", 6), 2000, constant(100 * MS), settle_s=3, servers=640)
    assert found.requests_per_s == pytest.approx(2000 / 0.32, rel=0.02)
    assert found.stalled < 0.01
