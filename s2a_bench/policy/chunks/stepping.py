"""A stepper in virtual ticks, with latencies that are known: what `Mode` does where no arrays do it."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import ChunkStepper, Cycles, Ints, Mode, Setting, Ticks

_Arrival: TypeAlias = tuple[int, int, int, int]
"""When actions are usable, from when on asking knows of them, the request, and how many of its actions that are."""


def step(mode: Mode, latency_ns: Ints, setting: Setting) -> tuple[Cycles, Ticks]:
    """Run a mode's stepper until it asks once more than there are latencies, shape (R,) in ns."""
    import numpy as np

    shifts = np.arange(setting.horizon) * mode.gap_ns
    return follow(mode, latency_ns[:, np.newaxis] + shifts, setting)


NEVER: Final = 2**61
"""An arrival that does not come, in ns."""


def follow(mode: Mode, arrival_ns: Ints, setting: Setting, most: int = NEVER) -> tuple[Cycles, Ticks]:
    """Do the same with the arrival of every action after the request's tick began: shape (R, H), in ns.

    It ends after ``most`` ticks, if there have been as many.
    """
    import numpy as np

    from s2a_bench.policy.chunks.cycles import gather

    count, horizon = len(arrival_ns), setting.horizon
    usable, known = setting.delay_ticks(arrival_ns), setting.known_ticks(arrival_ns)
    stepper = mode.stepper(setting)
    coming: list[_Arrival] = []
    leaves: list[int] = []
    chunk: list[int] = []
    index: list[int] = []
    tick = 0
    while tick < most:
        while coming and coming[0][:2] <= (tick, tick):
            _deliver(stepper, heapq.heappop(coming))
        if stepper.ask(tick):
            request = len(leaves)
            if request == count:
                break
            leaves.append(tick)
            times = list(zip((tick + usable[request]).tolist(), (tick + known[request]).tolist(), strict=True))
            for at, actions in {at: place for place, at in enumerate(times, 1)}.items():
                heapq.heappush(coming, (*at, request, actions))
        while coming and coming[0][0] <= tick:
            _deliver(stepper, heapq.heappop(coming))
        acted = stepper.act(tick)
        chunk.append(-1 if acted is None else acted.request)
        index.append(-1 if acted is None else acted.index)
        tick += 1
    request_tick = np.array(leaves, np.int64)
    usable_tick = request_tick + usable[:, -1]
    return gather(request_tick, usable_tick, np.array(chunk, np.int64), np.array(index, np.int64), horizon)


def _deliver(stepper: ChunkStepper, arrival: _Arrival) -> None:
    tick, _, request, actions = arrival
    stepper.arrived(request, actions, tick)
