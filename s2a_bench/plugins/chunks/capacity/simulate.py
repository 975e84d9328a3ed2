"""A fleet in virtual time: the robots' own steppers send requests to a server that answers in order of arrival.

A robot has one request under way. A request waits until one of the servers is free, then takes its service time; what
is spent beside the server (network, client) delays its answer and occupies no server. A free server takes as many
waiting requests as it batches. Nothing is late: a request leaves at its intended time.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from s2a_bench.plugins.chunks.capacity.config import RobotLoad
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode, Pace, Ticks
from s2a_bench.plugins.chunks.modes.cycles import drive

UNKNOWN: Final = -1


class ServiceTime(NamedTuple):
    first_ns: int
    """Time from the start of its service to its first piece, or `UNKNOWN`."""
    whole_ns: int
    """Time to its last piece, after which the server is free."""
    beside_ns: int = 0
    """Besides, where no server is occupied."""


class Answer(NamedTuple):
    """When an answer began, or `UNKNOWN`, and when it was complete, on the run's clock."""

    first_ns: int
    whole_ns: int


Robot: TypeAlias = "Generator[int, Answer, RobotTrace]"
"""Yields the time at which each request leaves, to be sent its answer."""


def simulate(
    load: RobotLoad,
    span_ns: int,
    robots: int,
    times: Iterator[ServiceTime],
    rng: np.random.Generator,
    servers: int = 1,
    slower: Sequence[float] = (1.0,),
) -> list[RobotTrace]:
    """Return the traces of ``robots`` robots that act for ``span_ns``, in each episode; `serve` is the server."""
    if not load.episode_ns:
        starts = rng.integers(0, load.cycle_ns + 1, robots).tolist()
        fleet = [robot_of(load, robot, start_ns, span_ns) for robot, start_ns in enumerate(starts)]
        return serve(fleet, times, servers, slower)
    traces = []
    for start_ns in range(0, span_ns, load.episode_ns):
        episode_ns = min(load.episode_ns, span_ns - start_ns)
        order = rng.permutation(robots).tolist()
        traces += serve([robot_of(load, each, start_ns, episode_ns) for each in order], times, servers, slower)
    return traces


def serve(
    robots: Sequence[Robot], times: Iterator[ServiceTime], servers: int = 1, slower: Sequence[float] = (1.0,)
) -> list[RobotTrace]:
    """Serve robots until all have ended.

    ``slower[b - 1]`` is by how many times longer b requests take together than one. Of those that arrive at one moment,
    the first robot is served first.
    """
    coming = [(next(robot), place) for place, robot in enumerate(robots)]
    heapq.heapify(coming)
    free_ns = [0] * servers
    waiting: deque[tuple[int, int]] = deque()
    traces: dict[int, RobotTrace] = {}
    while coming or waiting:
        if not waiting:
            waiting.append(heapq.heappop(coming))
        start_ns = max(free_ns[0], waiting[0][0])
        while coming and (coming[0][0] < start_ns or coming[0][0] == waiting[0][0]):
            waiting.append(heapq.heappop(coming))
        batch = [waiting.popleft() for _ in range(min(len(waiting), len(slower)))]
        time, factor = next(times), slower[len(batch) - 1]
        whole_ns = start_ns + round(time.whole_ns * factor)
        first_ns = UNKNOWN if time.first_ns == UNKNOWN else start_ns + round(time.first_ns * factor) + time.beside_ns
        answer = Answer(first_ns, whole_ns + time.beside_ns)
        heapq.heapreplace(free_ns, whole_ns)
        for _, place in batch:
            try:
                heapq.heappush(coming, (robots[place].send(answer), place))
            except StopIteration as end:
                traces[place] = end.value
    return [traces[place] for place in range(len(robots))]


def robot_of(load: RobotLoad, number: int, start_ns: int, span_ns: int) -> Robot:
    if load.mode is not None:
        return _acting(number, load.mode, load.setting, start_ns, max(1, span_ns // load.setting.period_ns))
    return _requesting(number, load.every_ns, load.think_ns, start_ns, start_ns + span_ns)


def _acting(robot: int, mode: Mode, setting: ControlSetting, start_ns: int, most: int) -> Robot:
    """Act for ``most`` ticks, with the mode's stepper where it has no pace."""
    times: list[tuple[int, int, int]] = []
    pace = mode.pace(setting)
    steps: Any = drive(mode, setting, most) if pace is None else _paced(pace, mode, setting, most)
    before_ns = np.arange(setting.horizon)[::-1] * mode.gap_ns
    try:
        tick = next(steps)
        while True:
            leave_ns = start_ns + tick * setting.period_ns
            answer = yield leave_ns
            times.append((leave_ns, answer.first_ns, answer.whole_ns))
            latency_ns = answer.whole_ns - leave_ns
            tick = steps.send(latency_ns if pace is not None else np.maximum(0, latency_ns - before_ns))
    except StopIteration as end:
        return _trace(robot, start_ns, start_ns + most * setting.period_ns, times, ticks=end.value[-1])


def _paced(pace: Pace, mode: Mode, setting: ControlSetting, most: int) -> Generator[int, int, tuple[Ticks]]:
    """Yield the tick of each request, to be sent its latency in ns."""
    latencies: list[int] = []
    tick, _ = next(pace)
    while tick < most:
        latency_ns = yield tick
        latencies.append(min(latency_ns, (most + 1 - tick) * setting.period_ns))  # no matter how long after the end
        tick, _ = pace.send((setting.delay(latency_ns), -(-latency_ns // setting.period_ns)))
    done = mode.ticks(np.array(latencies, np.int64), setting)
    kept = slice(most)
    return (Ticks(done.chunk[kept].copy(), done.index[kept].copy(), done.age[kept].copy(), done.stalled[kept].copy()),)


def _requesting(robot: int, every_ns: int, think_ns: int, start_ns: int, end_ns: int) -> Robot:
    """Request a plan every ``every_ns``, after the one before it; without it, again when it has the answer.

    A plan lasts until the next one is due, its pieces are even. It stalls if no start within that time is safe.
    """
    times: list[tuple[int, int, int]] = []
    due_ns, done_ns = start_ns, start_ns
    while due_ns < end_ns:
        answer = yield max(due_ns, done_ns)
        done_ns = answer.whole_ns
        times.append((due_ns, answer.first_ns, answer.whole_ns))
        due_ns = due_ns + every_ns if every_ns else done_ns + think_ns
    if not every_ns:
        return _trace(robot, start_ns, end_ns, times)
    late_ns = [max(first_ns - due_ns, whole_ns - due_ns - every_ns) for due_ns, first_ns, whole_ns in times]
    return _trace(robot, start_ns, end_ns, times, plan_stalled=np.array(late_ns) > every_ns)


def _trace(robot: int, start_ns: int, end_ns: int, times: Sequence[tuple[int, int, int]], **more: Any) -> RobotTrace:
    """Return a trace; ``times`` are the intended time of each request, and those of its `Answer`."""
    request_ns, first_ns, whole_ns = np.array(times, np.int64).T
    known_ns = None if UNKNOWN in first_ns else first_ns - request_ns
    return RobotTrace(robot, start_ns, end_ns, request_ns, whole_ns - request_ns, first_ns=known_ns, **more)
