"""Cycles and ticks of a mode, from arrays of takeover ticks or from a stepper in virtual time.

With arrays, an executed chunk is one run of ticks; stalls lie between runs.
"""

from __future__ import annotations

import heapq
from collections.abc import Generator
from typing import Final, TypeAlias

import numpy as np

from s2a_bench.plugins.chunks.modes import ChunkStepper, ControlSetting, Cycles, Ints, Mode, Pace, Ticks

_Arrival: TypeAlias = tuple[int, int, int, int]
"""The tick in which actions are usable, the tick in which `ask` knows them, the request, the number of its actions."""

NEVER: Final = 2**61
"""Arrival time of an action that never arrives, in ns."""


def assemble(
    request_tick: Ints, usable_tick: Ints, start_tick: Ints, first_index: Ints, until: Ints, *, ticks: int, horizon: int
) -> Cycles:
    """Return the cycles of runs: chunk r is executed from ``start_tick`` to before ``until``, both of shape (R,)."""
    executed: Ints = np.clip(np.minimum(until, ticks) - start_tick, 0, None)
    used = np.flatnonzero(executed)
    start, length = start_tick[used], executed[used]
    stall_ticks, jump = np.zeros((2, request_tick.size), np.int64)
    stall_ticks[used[1:]] = start[1:] - start[:-1] - length[:-1]
    done_before = np.cumsum(length) - length
    jump[used] = first_index[used] - (done_before - _executed_before(request_tick[used], start, length, done_before))
    return Cycles(
        request_tick=request_tick,
        usable_tick=usable_tick,
        start_tick=np.where(executed > 0, start_tick, ticks),
        first_index=np.where(executed > 0, first_index, 0),
        executed=executed,
        stall_ticks=stall_ticks,
        jump=jump,
        ticks=ticks,
        horizon=horizon,
    )


def paced(pace: Pace, delay: Ints, known: Ints) -> tuple[Ints, Ints]:
    """Return the tick of each request and of the one after them, and the actions left at each: (R + 1,) and (R,)."""
    requests = [next(pace), *map(pace.send, zip(delay.tolist(), known.tolist(), strict=True))]
    leaves, left = np.array(requests, np.int64).T
    return leaves, left[:-1]


def gather(request_tick: Ints, usable_tick: Ints, chunk: Ints, index: Ints, horizon: int) -> tuple[Cycles, Ticks]:
    """Return cycles and ticks from the chunk and index of each tick, shapes (K,), -1 for no action; runs may break."""
    count, ticks = request_tick.size, chunk.size
    acted = np.flatnonzero(chunk >= 0)
    by = chunk[acted]
    start_tick, first_index = np.full(count, ticks), np.zeros(count, np.int64)
    seen, place = np.unique(by, return_index=True)
    start_tick[seen], first_index[seen] = acted[place], index[acted[place]]
    stall_ticks, jump = np.zeros((2, count), np.int64)
    np.add.at(stall_ticks, by[1:], np.diff(acted) - 1)
    since = np.searchsorted(acted, start_tick[seen]) - np.searchsorted(acted, request_tick[seen])
    jump[seen] = first_index[seen] - since
    executed = np.bincount(by, minlength=count).astype(np.int64)
    cycles = Cycles(
        request_tick, usable_tick, start_tick, first_index, executed, stall_ticks, jump, ticks=ticks, horizon=horizon
    )
    age = np.where(chunk >= 0, np.arange(ticks) - request_tick[chunk], -1) if count else chunk
    begun = np.maximum.accumulate(chunk >= 0) if chunk.size else chunk >= 0
    return cycles, Ticks(chunk, index, age, np.asarray(begun & (chunk < 0)))


def lay(cycles: Cycles) -> Ticks:
    """Return the ticks of cycles with one run per chunk."""
    used = np.flatnonzero(cycles.executed)
    start, length = cycles.start_tick[used], cycles.executed[used]
    end = start + length
    spans = np.empty(2 * used.size + 1, np.int64)  # idle, run, idle, run, ..., idle
    spans[1::2] = length
    spans[0:-1:2] = start - np.concatenate(([0], end[:-1]))
    spans[-1] = cycles.ticks - (end[-1] if used.size else 0)
    idle = np.full(spans.size, -1, np.int64)

    def spread(values: Ints) -> Ints:
        each = idle.copy()
        each[1::2] = values
        return np.repeat(each, spans)

    chunk, tick = spread(used), np.arange(cycles.ticks)
    stalled = chunk < 0
    index, age = tick - spread(start - cycles.first_index[used]), tick - spread(cycles.request_tick[used])
    index[stalled], age[stalled] = -1, -1
    stalled[: start[0] if used.size else cycles.ticks] = False
    return Ticks(chunk, index, age, stalled)


def _executed_before(tick: Ints, start: Ints, length: Ints, done_before: Ints) -> Ints:
    run = np.searchsorted(start, tick, "right") - 1
    inside = np.minimum(tick - start[run], length[run])
    return np.where(run < 0, 0, done_before[run] + inside)


def arrivals(mode: Mode, latency_ns: Ints, setting: ControlSetting) -> Ints:
    """Return the arrival of every action, shape (R, H), of chunks with latencies of shape (R,); both in ns."""
    latency_ns = latency_ns[:, np.newaxis]
    if not mode.gap_ns:
        return np.broadcast_to(latency_ns, (len(latency_ns), setting.horizon))
    return latency_ns + np.arange(setting.horizon) * mode.gap_ns


def step(mode: Mode, latency_ns: Ints, setting: ControlSetting) -> tuple[Cycles, Ticks]:
    """Run a mode's stepper until its first request without a latency; ``latency_ns`` has the shape (R,)."""
    return follow(mode, arrivals(mode, latency_ns, setting), setting)


def follow(mode: Mode, arrival_ns: Ints, setting: ControlSetting, most: int = NEVER) -> tuple[Cycles, Ticks]:
    """Run a mode's stepper with the arrival of every action after its request's tick began: shape (R, H), in ns.

    It ends after ``most`` ticks, or before the first request without arrivals.
    """
    steps = drive(mode, setting, most)
    try:
        next(steps)
        for row in (*arrival_ns, None):
            steps.send(row)
    except StopIteration as end:
        done: tuple[Cycles, Ticks] = end.value
    return done


def drive(mode: Mode, setting: ControlSetting, most: int = NEVER) -> Generator[int, Ints | None, tuple[Cycles, Ticks]]:
    """Run a mode's stepper: yield the tick of each request, to be sent the arrivals of its actions, as in `follow`.

    It ends after ``most`` ticks, or before the first request that is sent None.
    """
    stepper = mode.stepper(setting)
    coming: list[_Arrival] = []
    leaves: list[int] = []
    usable_tick: list[int] = []
    chunk: list[int] = []
    index: list[int] = []
    tick = 0
    while tick < most:
        while coming and coming[0][:2] <= (tick, tick):
            _deliver(stepper, heapq.heappop(coming))
        if stepper.ask(tick):
            arrival_ns = yield tick
            if arrival_ns is None:
                break
            usable = (tick + setting.delay_ticks(arrival_ns)).tolist()
            known = (tick + setting.known_ticks(arrival_ns)).tolist()
            arrived = {at: actions for actions, at in enumerate(zip(usable, known, strict=True), 1)}
            for (usable_at, known_at), actions in arrived.items():
                heapq.heappush(coming, (usable_at, known_at, len(leaves), actions))
            leaves.append(tick)
            usable_tick.append(usable[0])
        while coming and coming[0][0] <= tick:
            _deliver(stepper, heapq.heappop(coming))
        acted = stepper.act(tick)
        chunk.append(-1 if acted is None else acted.request)
        index.append(-1 if acted is None else acted.index)
        tick += 1
    request_tick, usable_ticks = np.array(leaves, np.int64), np.array(usable_tick, np.int64)
    return gather(request_tick, usable_ticks, np.array(chunk, np.int64), np.array(index, np.int64), setting.horizon)


def _deliver(stepper: ChunkStepper, arrival: _Arrival) -> None:
    tick, _, request, actions = arrival
    stepper.arrived(request, actions, tick)
