"""Blend overlapping actions, with the timing and the weights of lerobot's asynchronous inference.

Action i of a chunk is due when i actions have been executed since the chunk's observation: a stall delays actions, and
loses none. lerobot sends an observation in every tick with few actions left, and a free server takes the newest. Here
one request is pending at a time, which is equivalent for observations that arrive at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

import numpy as np
from pydantic import Field

from s2a_bench.plugins.chunks.modes import ChunkAction, ChunkStepper, ControlSetting, Cycles, Ints, Mode, Pace, Ticks
from s2a_bench.plugins.chunks.modes.closed import Closed, stall_share
from s2a_bench.plugins.chunks.modes.cycles import assemble, lay, paced
from s2a_bench.policy import Floats

Kind: TypeAlias = Literal["weighted_average", "latest_only", "average", "conservative"]
WEIGHTS: Final[Mapping[Kind, float]] = {
    "weighted_average": 0.7,
    "latest_only": 1.0,
    "average": 0.5,
    "conservative": 0.3,
}
"""Weight of the new action by kind; the queued one has the rest (lerobot, AGGREGATE_FUNCTIONS)."""


@dataclass(frozen=True, slots=True)
class Aggregate(Mode):
    """Request a chunk when ``trigger`` actions are left, and blend it into them where both have an action."""

    name: ClassVar[str] = "aggregate"

    trigger: Annotated[int, Field(ge=0)] = 0
    kind: Kind = "weighted_average"

    @property
    def weight(self) -> float:
        return WEIGHTS[self.kind]

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return AggregateStepper(setting.horizon, self.trigger)

    def execution_horizon(self, setting: ControlSetting) -> int:
        return max(0, setting.horizon - self.trigger)

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        if 2 * self.trigger >= setting.horizon:
            return Closed()
        delay = setting.delay_ticks(latency_ns)
        cycle = delay + setting.horizon - np.minimum(delay, self.trigger) - self.trigger
        return Closed(stall_share(delay, self.trigger), delay, cycle)

    def pace(self, setting: ControlSetting) -> Pace:
        now = left = 0
        while True:
            delay, known = yield now, left
            end = now + max(delay - left, 0) + setting.horizon
            now = max(end - self.trigger, now + max(known, 1))
            left = max(end - now, 0)

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles:
        # With q actions left at the request, min(d, q) of the new chunk are past when it arrives.
        latency_ns = arrival_ns[:, -1]
        delay, horizon = setting.delay_ticks(latency_ns), setting.horizon
        leaves, left = paced(self.pace(setting), delay, setting.known_ticks(latency_ns))
        request, first = leaves[:-1], np.minimum(delay, left)
        usable = request + delay
        until = np.minimum(np.append(usable[1:], leaves[-1]), usable + horizon - first)
        return assemble(request, usable, usable, first, until, ticks=int(leaves[-1]), horizon=horizon)

    def blend(self, cycles: Cycles, ticks: Ticks) -> Iterator[tuple[Ints, Ints, Ints, Floats]]:
        """Yield the components of executed actions as arrays: ticks, chunks, indices, weights; the newest chunks first.

        The weights of a tick add up to 1.
        """
        weight = self.weight
        acted = np.flatnonzero(ticks.chunk >= 0)
        newest, index = ticks.chunk[acted], ticks.index[acted]
        due = np.searchsorted(acted, cycles.request_tick)  # due time of action 0, in actions since the start
        action = due[newest] + index
        rest = np.ones(acted.size)
        open_, chunk = np.arange(acted.size), newest
        while open_.size:
            older = chunk - 1
            also = (older >= 0) & (action[open_] < due[np.maximum(older, 0)] + cycles.horizon)
            share = np.where(also, weight, 1.0) * rest[open_]
            yield acted[open_], chunk, action[open_] - due[chunk], share
            rest[open_] -= share
            open_, chunk = open_[also], older[also]

    def blended_age(self, cycles: Cycles) -> Floats:
        blended = np.full(cycles.ticks, np.nan)
        for tick, chunk, _, share in self.blend(cycles, lay(cycles)):
            blended[tick] = np.nan_to_num(blended[tick]) + share * (tick - cycles.request_tick[chunk])
        return blended


@dataclass(slots=True)
class AggregateStepper(ChunkStepper):
    """State of the newest chunk."""

    horizon: int
    trigger: int = 0
    newest: int = -1
    past: int = 0
    """Actions executed since the newest chunk's observation."""
    since_request: int = 0
    """Actions executed since the pending request's observation."""
    pending: bool = False

    def arrived(self, request: int, actions: int, tick: int) -> None:  # noqa: ARG002 - chunks arrive whole
        self.newest, self.past, self.pending = request, self.since_request, False

    def ask(self, tick: int) -> bool:  # noqa: ARG002 - the time does not matter
        left = self.horizon - self.past if self.newest >= 0 else 0
        if self.pending or left > self.trigger:
            return False
        self.pending, self.since_request = True, 0
        return True

    def act(self, tick: int) -> ChunkAction | None:  # noqa: ARG002 - the time does not matter
        if self.newest < 0 or self.past == self.horizon:
            return None
        self.past += 1
        self.since_request += 1
        return ChunkAction(self.newest, self.past - 1)
