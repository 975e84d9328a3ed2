"""Chunks one after another: each is executed from its first action on, behind what is left of the one before.

No action is skipped, so at every boundary the robot is thrown back by the m actions that were executed since the
observation. One request is under way at a time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from s2a_bench.policy.chunks import Action, Cycles, Setting
from s2a_bench.policy.chunks.cycles import Laid
from s2a_bench.policy.chunks.stepping import step

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import ChunkStepper, Ints, Ticks

Execute = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, slots=True)
class Queue(Laid):
    """Ask when ``trigger`` actions are left, and append; ``execute`` is s, 0 for the whole chunk."""

    name: ClassVar[str] = "queue"

    trigger: Annotated[int, Field(ge=0)] = 0
    execute: Execute = 0

    def stepper(self, setting: Setting) -> ChunkStepper:
        """Follow one robot."""
        return QueueStepper(self.trigger, length_of(self.execute, setting))

    def cycles(self, latency_ns: Ints, setting: Setting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns."""
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        return _append(delay, known, delay, self.trigger, length_of(self.execute, setting), setting.horizon)


@dataclass(frozen=True, slots=True)
class Sync(Laid):
    """Ask when the chunk is used up, and stand still meanwhile: the loop is blocked while it stalls."""

    name: ClassVar[str] = "sync"
    blocks: ClassVar[bool] = True

    execute: Execute = 0

    def stepper(self, setting: Setting) -> ChunkStepper:
        """Follow one robot."""
        return Queue(0, self.execute).stepper(setting)

    def cycles(self, latency_ns: Ints, setting: Setting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns."""
        return Queue(0, self.execute).cycles(latency_ns, setting)


@dataclass(frozen=True, slots=True)
class Streamed(Laid):
    """As queue, with actions that arrive one after another: the first after L, then one every ``gap_s``.

    ``start=safe`` begins a chunk at S0, as soon as no stall within it can follow: L and then s - 1 times gap - Delta t,
    rounded up to ticks, since a robot sees ticks only; that is at most one tick after the exact S0. ``start=naive``
    executes what there is. By T1 both stall equally long in all, naive within chunks too. ``trigger`` counts actions
    that are here or under way; the next request leaves when all actions of this one have arrived at the earliest.
    """

    name: ClassVar[str] = "streamed"
    streams: ClassVar[bool] = True

    trigger: Annotated[int, Field(ge=0)] = 0
    execute: Execute = 0
    gap_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    start: Literal["safe", "naive"] = "safe"

    @property
    def gap_ns(self) -> int:
        """Return the time from one action's arrival to the next one's."""
        return round(self.gap_s * 1e9)

    def hold_ticks(self, setting: Setting) -> int:
        """Return for how many ticks the first action is held back, S0 - L rounded up."""
        slower_ns = max(0, self.gap_ns - setting.period_ns) if self.start == "safe" else 0
        return -(-(length_of(self.execute, setting) - 1) * slower_ns // setting.period_ns)

    def stepper(self, setting: Setting) -> ChunkStepper:
        """Follow one robot."""
        return QueueStepper(self.trigger, length_of(self.execute, setting), self.hold_ticks(setting))

    def cycles(self, latency_ns: Ints, setting: Setting) -> Cycles:
        """Say what becomes of requests whose first actions have latencies of shape (R,), in ns."""
        if self.start == "naive" and self.gap_ns > setting.period_ns:
            return step(self, latency_ns, setting)[0]
        length = length_of(self.execute, setting)
        known = setting.known_ticks(latency_ns + (length - 1) * self.gap_ns)
        whole = setting.delay_ticks(latency_ns + (setting.horizon - 1) * self.gap_ns)
        ready = setting.delay_ticks(latency_ns) + self.hold_ticks(setting)
        return _append(ready, known, whole, self.trigger, length, setting.horizon)

    def ticks(self, latency_ns: Ints, setting: Setting) -> Ticks:
        """Say what each tick does."""
        if self.start == "naive" and self.gap_ns > setting.period_ns:
            return step(self, latency_ns, setting)[1]
        return Laid.ticks(self, latency_ns, setting)


@dataclass(slots=True)
class QueueStepper:
    """A queue of actions; the first of a chunk is held back for ``hold`` ticks after it arrived."""

    trigger: int
    length: int
    hold: int = 0
    waiting: deque[tuple[Action, int]] = field(default_factory=deque)
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
            self.waiting.append((Action(request, index), tick + (0 if index else self.hold)))
        self.missing = self.length - max(have, min(actions, self.length))

    def ask(self, tick: int) -> bool:  # noqa: ARG002 - whenever few are left
        """Ask when few actions are left, and none is under way."""
        if self.missing or len(self.waiting) > self.trigger:
            return False
        self.asked += 1
        self.missing = self.length
        return True

    def act(self, tick: int) -> Action | None:
        """Execute the next action."""
        if not self.waiting or self.waiting[0][1] > tick:
            return None
        return self.waiting.popleft()[0]


def length_of(execute: int, setting: Setting) -> int:
    """Return s; raises ValueError where a chunk has fewer actions."""
    if execute > setting.horizon:
        raise ValueError(f"execute = {execute} of a chunk of {setting.horizon} actions")
    return execute or setting.horizon


def _append(ready: Ints, known: Ints, whole: Ints, trigger: int, length: int, horizon: int) -> Cycles:
    """Append chunks that may begin ``ready`` ticks after the request, shapes (R,).

    With q actions left at the request at k, the chunk begins at e = k + max(q, ready), and the next request leaves when
    ``trigger`` are left and all are known to be here, at max(e + length - trigger, k + known). Where that is always the
    former, q is always the trigger, and nothing depends on what was before.
    """
    import numpy as np

    from s2a_bench.policy.chunks.cycles import assemble

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
