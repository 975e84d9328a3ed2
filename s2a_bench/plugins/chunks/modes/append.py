"""Chunks one after another: each is executed from its first action on, after the rest of the one before.

No action is skipped, so at every boundary the robot jumps back by the m actions executed since the observation. One
request is pending at a time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from s2a_bench.plugins.chunks.modes import ChunkAction, ChunkStepper, ControlSetting, Cycles, Ints, Mode, Pace
from s2a_bench.plugins.chunks.modes.closed import Closed, appended
from s2a_bench.plugins.chunks.modes.cycles import assemble, paced
from s2a_bench.plugins.chunks.modes.trigger import Varied

Execute = Annotated[int, Field(ge=0)]


class Appending(Mode):
    """A mode that executes the first ``execute`` actions of each chunk; 0: the whole chunk."""

    execute: int

    def execution_horizon(self, setting: ControlSetting) -> int:
        return setting.length(self.execute)

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return QueueStepper(self.execution_horizon(setting), self.trigger or 0)

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        return appended(delay, known, self.trigger or 0, self.execution_horizon(setting))

    def pace(self, setting: ControlSetting) -> Pace | None:
        return None if self.streams else _requests((self.trigger or 0,), self.execution_horizon(setting))

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles | None:
        delay, known = setting.delay_ticks(arrival_ns[:, -1]), setting.known_ticks(arrival_ns[:, -1])
        return _append(delay, delay, known, (self.trigger or 0,), self.execution_horizon(setting), setting.horizon)


@dataclass(frozen=True, slots=True)
class Queue(Appending):
    """Request a chunk when ``trigger`` actions are left, and append it; ``execute`` is s, 0 for the whole chunk."""

    name: ClassVar[str] = "queue"
    triggered: ClassVar[bool] = True

    trigger: Annotated[int, Field(ge=0)] = 0
    execute: Execute = 0

    def varied(self, triggers: tuple[int, ...]) -> Mode:
        return VariedQueue(self, triggers) if len(triggers) > 1 else replace(self, trigger=triggers[0])


class VariedQueue(Varied):
    """`Queue` with one trigger per request."""

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles:
        delay, known = setting.delay_ticks(arrival_ns[:, -1]), setting.known_ticks(arrival_ns[:, -1])
        return _append(delay, delay, known, self.triggers, self.mode.execution_horizon(setting), setting.horizon)


@dataclass(frozen=True, slots=True)
class Sync(Appending):
    """Request a chunk when the last one is used up, and stall meanwhile with a blocked loop."""

    name: ClassVar[str] = "sync"
    blocks: ClassVar[bool] = True
    assumed_ticks: ClassVar[int] = 0

    execute: Execute = 0


@dataclass(frozen=True, slots=True)
class Streamed(Appending):
    """As queue, with actions that arrive one after another: the first after L, then one every ``gap_s``.

    ``start=safe`` begins a chunk at S0, from which on no stall within it can follow: L plus s - 1 times gap - Delta t,
    rounded up to ticks, so at most one tick after the exact S0. ``start=naive`` executes actions as they arrive. By T1
    the stalls of both add up to the same; with naive they are within chunks too. ``trigger`` counts actions that have
    arrived or are pending; the next request leaves after all actions of this one have arrived.
    """

    name: ClassVar[str] = "streamed"
    streams: ClassVar[bool] = True
    assumed_ticks: ClassVar[None] = None

    trigger: Annotated[int, Field(ge=0)] = 0
    execute: Execute = 0
    gap_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    start: Literal["safe", "naive"] = "safe"

    @property
    def gap_ns(self) -> int:
        return round(self.gap_s * 1e9)

    def hold_ticks(self, setting: ControlSetting) -> int:
        """Return the ticks by which the first action is delayed, S0 - L rounded up."""
        slower_ns = max(0, self.gap_ns - setting.period_ns) if self.start == "safe" else 0
        return -(-(self.execution_horizon(setting) - 1) * slower_ns // setting.period_ns)

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return QueueStepper(self.execution_horizon(setting), self.trigger, self.hold_ticks(setting))

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        if self.start == "naive" and self.gap_ns > setting.period_ns:  # it may stall within a chunk
            return Closed()
        length = self.execution_horizon(setting)
        known = setting.known_ticks(latency_ns + (length - 1) * self.gap_ns)
        return appended(setting.delay_ticks(latency_ns) + self.hold_ticks(setting), known, self.trigger, length)

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles | None:
        length = self.execution_horizon(setting)
        usable, known = setting.delay_ticks(arrival_ns[:, :length]), setting.known_ticks(arrival_ns[:, length - 1])
        ready = usable[:, 0] + self.hold_ticks(setting)
        if (usable - np.arange(length) > ready[:, np.newaxis]).any():
            return None  # an action arrives after its turn: the chunk is not a single run
        if self.trigger >= length and (ready > known).any():
            return None  # the next request leaves while the chunk is held back
        return _append(usable[:, 0], ready, known, (self.trigger,), length, setting.horizon)


@dataclass(slots=True)
class QueueStepper(ChunkStepper):
    """A queue of actions; the first of a chunk is delayed by ``hold`` ticks after its arrival."""

    length: int
    trigger: int = 0
    hold: int = 0
    waiting: deque[tuple[ChunkAction, int]] = field(default_factory=deque)
    """Actions, each with the first tick in which it may be executed."""
    requests: int = 0
    missing: int = 0
    """Pending actions."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        if request < self.requests - 1:  # actions beyond s of an older chunk
            return
        have = self.length - self.missing
        for index in range(have, min(actions, self.length)):
            self.waiting.append((ChunkAction(request, index), tick + (0 if index else self.hold)))
        self.missing = self.length - max(have, min(actions, self.length))

    def ask(self, tick: int) -> bool:  # noqa: ARG002 - the time does not matter
        if self.missing or len(self.waiting) > self.trigger:
            return False
        self.requests += 1
        self.missing = self.length
        return True

    def act(self, tick: int) -> ChunkAction | None:
        if not self.waiting or self.waiting[0][1] > tick:
            return None
        return self.waiting.popleft()[0]


def _requests(triggers: tuple[int, ...], length: int) -> Pace:
    """Request when as many actions are left as the trigger, the last for all later ones, and all have arrived."""
    now = left = 0
    for request in count(1):
        ready, known = yield now, left
        end = now + max(left, ready) + length
        now = max(end - triggers[min(request, len(triggers) - 1)], now + known, now + 1)
        left = end - now


def _append(delay: Ints, ready: Ints, known: Ints, triggers: tuple[int, ...], length: int, horizon: int) -> Cycles:
    """Append chunks that may begin ``ready`` ticks after the request, shapes (R,)."""
    leaves, left = paced(_requests(triggers, length), ready, known)
    request_tick = leaves[:-1]
    start = request_tick + np.maximum(left, ready)
    first, until = np.zeros_like(start), start + length
    return assemble(request_tick, request_tick + delay, start, first, until, ticks=int(leaves[-1]), horizon=horizon)
