"""Request a chunk every s ticks; it takes over where it is due: the timing of real-time chunking and its family.

Action i is due i ticks after its chunk's observation, on the clock: a stall loses the actions due meanwhile. The first
chunk is due from the tick of its arrival.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from s2a_bench.plugins.chunks.modes import ChunkAction, ChunkStepper, ControlSetting, Cycles, Ints, Mode, Pace
from s2a_bench.plugins.chunks.modes.closed import Closed, replace_stall_share, stall_share
from s2a_bench.plugins.chunks.modes.cycles import assemble, paced


@dataclass(frozen=True, slots=True)
class Replace(Mode):
    """Request a chunk ``execute`` ticks after the last request; it takes over at index now - observation.

    ``under_way=one`` waits for the answer before the next request, so a cycle lasts max(s, ceil(L / Delta t)) ticks;
    ``many`` does not, and drops an answer that a newer one has overtaken. With ``assumed`` >= 0 a chunk takes over at
    that index for any delay: a fixed estimate of d, which makes the robot jump by estimate - d actions.
    """

    name: ClassVar[str] = "replace"

    execute: Annotated[int, Field(ge=1)] = 8
    under_way: Literal["one", "many"] = "one"
    assumed: Annotated[int, Field(ge=-1)] = -1

    @property
    def several(self) -> bool:
        return self.under_way == "many"

    @property
    def assumed_ticks(self) -> int | None:
        return None if self.assumed < 0 else self.assumed

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return ReplaceStepper(self, setting.horizon)

    def execution_horizon(self, setting: ControlSetting) -> int:
        return setting.length(self.execute)

    def slack(self, setting: ControlSetting) -> int:
        """Return the greatest d without a stall: H - s, and with one pending request at most H / 2.

        With one pending request d may exceed s; the cycle then lasts d ticks, and the chunk has to last for two delays
        (at whole L / Delta t; otherwise known is d + 1 if actions leave at the end of their tick).
        """
        slack = setting.horizon - self.execute
        return slack if self.several else min(slack, setting.horizon // 2)

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        if self.assumed >= 0:
            return Closed()
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        if not self.several:
            share = replace_stall_share(delay, known, self.execute, setting.horizon)
            cycle = np.maximum(self.execute, known)
        elif delay.max() > self.execute:
            return Closed()
        else:
            share = stall_share(delay, setting.horizon - self.execute)
            cycle = np.full_like(delay, self.execute)
        return Closed(share, delay, cycle) if delay.max() < setting.horizon else Closed(share)

    def pace(self, setting: ControlSetting) -> Pace:  # noqa: ARG002 - the horizon does not matter
        delay, _ = yield 0, 0
        now = delay + self.execute
        while True:
            _, known = yield now, 0
            now += self.execute if self.several else max(self.execute, known)

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles:
        latency_ns = arrival_ns[:, -1]
        delay = setting.delay_ticks(latency_ns)
        leaves, _ = paced(self.pace(setting), delay, setting.known_ticks(latency_ns))
        request = leaves[:-1]
        usable = request + delay
        first = delay.copy() if self.assumed < 0 else np.full_like(delay, self.assumed)
        first[:1] = 0
        newer = np.append(np.minimum.accumulate(usable[:0:-1])[::-1], leaves[-1])
        until = np.minimum(newer, usable + setting.horizon - first)
        return assemble(request, usable, usable, first, until, ticks=int(leaves[-1]), horizon=setting.horizon)


@dataclass(slots=True)
class ReplaceStepper(ChunkStepper):
    """State of the newest chunk."""

    rule: Replace
    horizon: int
    next_request: int = 0
    pending: dict[int, int] = field(default_factory=dict)
    """Request -> the tick in which it left."""
    requests: int = 0
    newest: int = -1
    due_from: int = 0

    def arrived(self, request: int, actions: int, tick: int) -> None:  # noqa: ARG002 - chunks arrive whole
        left_at = self.pending.pop(request)
        if request == 0:
            self.next_request = tick + self.rule.execute
        if request > self.newest:
            self.newest = request
            self.due_from = left_at if self.rule.assumed < 0 else tick - self.rule.assumed
            if request == 0:
                self.due_from = tick

    def ask(self, tick: int) -> bool:
        waits = self.pending and (not self.rule.several or self.newest < 0)
        if tick < self.next_request or waits:
            return False
        self.pending[self.requests] = tick
        self.requests += 1
        self.next_request = tick + self.rule.execute
        return True

    def act(self, tick: int) -> ChunkAction | None:
        index = tick - self.due_from
        return ChunkAction(self.newest, index) if self.newest >= 0 and index < self.horizon else None
