"""Chunks one after another: each is executed from its first action on, behind what is left of the one before.

No action is skipped, so at every boundary the robot is thrown back by the m actions that were executed since the
observation. One request is under way at a time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from s2a_bench.policy.chunks import ChunkAction, ChunkStepper, ControlSetting, Cycles, Ints, Mode, Ticks
from s2a_bench.policy.chunks.closed import Closed, appended
from s2a_bench.policy.chunks.cycles import Laid, assemble, lay, step
from s2a_bench.policy.chunks.trigger import Varied

Execute = Annotated[int, Field(ge=0)]


class Appending(Laid):
    """A mode that executes the first ``execute`` actions of each chunk; 0: the whole chunk."""

    execute: int

    def execution_horizon(self, setting: ControlSetting) -> int:
        return setting.length(self.execute)


@dataclass(frozen=True, slots=True)
class Queue(Appending):
    """Ask when ``trigger`` actions are left, and append; ``execute`` is s, 0 for the whole chunk."""

    name: ClassVar[str] = "queue"
    triggered: ClassVar[bool] = True

    trigger: Annotated[int, Field(ge=0)] = 0
    execute: Execute = 0

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return QueueStepper(self.execution_horizon(setting), self.trigger)

    def varied(self, triggers: tuple[int, ...]) -> Mode:
        return VariedQueue(self, triggers) if len(triggers) > 1 else replace(self, trigger=triggers[0])

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        return appended(delay, known, self.trigger, self.execution_horizon(setting))

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        return _append(delay, known, delay, self.trigger, self.execution_horizon(setting), setting.horizon)


class VariedQueue(Varied):
    """The same with a trigger for each request."""

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns, one request at a time."""
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        length, last = self.mode.execution_horizon(setting), len(self.triggers) - 1
        leaves, starts, left = [0], [], 0
        for request, (ticks, here) in enumerate(zip(delay.tolist(), known.tolist(), strict=True)):
            now = leaves[-1]
            starts.append(now + max(left, ticks))
            end = starts[-1] + length
            leaves.append(max(end - self.triggers[min(request + 1, last)], now + max(here, 1)))
            left = max(0, end - leaves[-1])
        asked, start = np.array(leaves[:-1], np.int64), np.array(starts, np.int64)
        first, until = np.zeros_like(start), start + length
        return assemble(asked, asked + delay, start, first, until, ticks=leaves[-1], horizon=setting.horizon)

    def ticks(self, latency_ns: Ints, setting: ControlSetting) -> Ticks:
        return lay(self.cycles(latency_ns, setting))


@dataclass(frozen=True, slots=True)
class Sync(Appending):
    """Ask when the chunk is used up, and stand still meanwhile: the loop is blocked while it stalls."""

    name: ClassVar[str] = "sync"
    blocks: ClassVar[bool] = True
    assumed_ticks: ClassVar[int] = 0

    execute: Execute = 0

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return Queue(0, self.execute).stepper(setting)

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        return Queue(0, self.execute).closed_form(latency_ns, setting)

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        return Queue(0, self.execute).cycles(latency_ns, setting)


@dataclass(frozen=True, slots=True)
class Streamed(Appending):
    """As queue, with actions that arrive one after another: the first after L, then one every ``gap_s``.

    ``start=safe`` begins a chunk at S0, as soon as no stall within it can follow: L and then s - 1 times gap - Delta t,
    rounded up to ticks, since a robot sees ticks only; that is at most one tick after the exact S0. ``start=naive``
    executes what there is. By T1 both stall equally long in all, naive within chunks too. ``trigger`` counts actions
    that are here or under way; the next request leaves when all actions of this one have arrived at the earliest.
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
        """Return for how many ticks the first action is held back, S0 - L rounded up."""
        slower_ns = max(0, self.gap_ns - setting.period_ns) if self.start == "safe" else 0
        return -(-(self.execution_horizon(setting) - 1) * slower_ns // setting.period_ns)

    def waits_within(self, setting: ControlSetting) -> bool:
        """Whether it may stall within a chunk: then neither arrays nor a closed form tell."""
        return self.start == "naive" and self.gap_ns > setting.period_ns

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        return QueueStepper(self.execution_horizon(setting), self.trigger, self.hold_ticks(setting))

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:
        if self.waits_within(setting):
            return Closed()
        length = self.execution_horizon(setting)
        known = setting.known_ticks(latency_ns + (length - 1) * self.gap_ns)
        return appended(setting.delay_ticks(latency_ns) + self.hold_ticks(setting), known, self.trigger, length)

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        if self.waits_within(setting):
            return step(self, latency_ns, setting)[0]
        length = self.execution_horizon(setting)
        known = setting.known_ticks(latency_ns + (length - 1) * self.gap_ns)
        whole = setting.delay_ticks(latency_ns + (setting.horizon - 1) * self.gap_ns)
        ready = setting.delay_ticks(latency_ns) + self.hold_ticks(setting)
        return _append(ready, known, whole, self.trigger, length, setting.horizon)

    def ticks(self, latency_ns: Ints, setting: ControlSetting) -> Ticks:
        if self.waits_within(setting):
            return step(self, latency_ns, setting)[1]
        return Laid.ticks(self, latency_ns, setting)


@dataclass(slots=True)
class QueueStepper(ChunkStepper):
    """A queue of actions; the first of a chunk is held back for ``hold`` ticks after it arrived."""

    length: int
    trigger: int = 0
    hold: int = 0
    waiting: deque[tuple[ChunkAction, int]] = field(default_factory=deque)
    """Actions, and from which tick on they may be executed."""
    asked: int = 0
    missing: int = 0
    """Actions under way."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        """Queue what is new, as far as it is to be executed; the rest of an older chunk may still trickle in."""
        if request < self.asked - 1:
            return
        have = self.length - self.missing
        for index in range(have, min(actions, self.length)):
            self.waiting.append((ChunkAction(request, index), tick + (0 if index else self.hold)))
        self.missing = self.length - max(have, min(actions, self.length))

    def ask(self, tick: int) -> bool:  # noqa: ARG002 - whenever few are left
        """Ask when few actions are left, and none is under way."""
        if self.missing or len(self.waiting) > self.trigger:
            return False
        self.asked += 1
        self.missing = self.length
        return True

    def act(self, tick: int) -> ChunkAction | None:
        if not self.waiting or self.waiting[0][1] > tick:
            return None
        return self.waiting.popleft()[0]


def _append(ready: Ints, known: Ints, whole: Ints, trigger: int, length: int, horizon: int) -> Cycles:
    """Append chunks that may begin ``ready`` ticks after the request, shapes (R,).

    With q actions left at the request at k, the chunk begins at e = k + max(q, ready), and the next request leaves when
    ``trigger`` are left and all are known to be here, at max(e + length - trigger, k + known). Where that is always the
    former, q is always the trigger, and nothing depends on what was before.
    """
    left = np.full(ready.size, trigger)
    left[:1] = 0
    step = np.maximum(left, ready) + length - trigger
    if (step >= np.maximum(known, 1)).all():
        leaves = np.concatenate(([0], np.cumsum(step)))
    else:
        leaves_at, left_then = [0], [0]
        for begins, here in zip(ready.tolist(), known.tolist(), strict=True):
            now = leaves_at[-1]
            begin = now + max(left_then[-1], begins)
            leaves_at.append(max(begin + length - trigger, now + here, now + 1))
            left_then.append(begin + length - leaves_at[-1])
        leaves, left = np.array(leaves_at), np.array(left_then[:-1], np.int64)
    request = leaves[:-1]
    start = request + np.maximum(left, ready)
    first, until = np.zeros_like(start), start + length
    return assemble(request, request + whole, start, first, until, ticks=int(leaves[-1]), horizon=horizon)
