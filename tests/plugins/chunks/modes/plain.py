"""Robots with chunks again, as a loop over events in continuous nanoseconds: slow and obvious, to check ticks against.

Nothing is counted in ticks but the robot's own clock: observations are made when a tick begins, actions leave when it
ends (floor) or begins (ceil), and answers come whenever they come. Each mode is what its definition says, on a dict of
actions that lie ready.
"""

# ruff: noqa: ARG002 - the calls of a robot are the same for all of them

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class Log:
    """What happened."""

    acts: list[tuple[int, int] | None] = field(default_factory=list)
    """Each tick's chunk and index."""
    blends: list[dict[int, float]] = field(default_factory=list)
    """Each tick's weights by chunk, for aggregate."""
    asked_ns: list[int] = field(default_factory=list)
    arrived_ns: list[int] = field(default_factory=list)
    acted_ns: list[int] = field(default_factory=list)
    """When each tick's action left, or would have."""


@dataclass
class Robot:
    """A robot without a mode: who asks, and what becomes of an answer, is for its subclasses."""

    latencies: Sequence[int]
    period: int
    horizon: int
    rounding: str
    gap: int = 0
    log: Log = field(default_factory=Log)

    def run(self) -> Log:
        """Go on until there is no latency for the next request."""
        acts_first = self.rounding == "floor"
        act, arrive, ask = (0, 1, 2) if acts_first else (2, 0, 1)
        events: list[tuple[int, int, int, int]] = [(0, ask, 0, 0)]
        while True:
            now, kind, first, second = heapq.heappop(events)
            if kind == ask:
                tick = first
                if self.wants(tick):
                    if len(self.log.asked_ns) == len(self.latencies):
                        # What began at the same moment is over, and nothing that comes later counts.
                        return self.log
                    request = len(self.log.asked_ns)
                    self.log.asked_ns.append(now)
                    self.asks(request, tick)
                    for index in range(self.horizon):
                        at = now + self.latencies[request] + index * self.gap
                        heapq.heappush(events, (at, arrive, request, index))
                    self.log.arrived_ns.append(at)
                heapq.heappush(events, (now + self.period * acts_first, act, tick, 0))
                heapq.heappush(events, (now + self.period, ask, tick + 1, 0))
            elif kind == arrive:
                self.gets(first, second, now)
            else:
                self.log.acts.append(self.does(first))
                self.log.acted_ns.append(now)

    def tick_of(self, now: int) -> int:
        """Return the first tick whose action is still to leave."""
        return now // self.period if self.rounding == "floor" else -(-now // self.period)

    def wants(self, tick: int) -> bool:
        """Return whether it asks."""
        raise NotImplementedError

    def asks(self, request: int, tick: int) -> None:
        """Remember the request."""

    def gets(self, request: int, index: int, now: int) -> None:
        """Take an action."""
        raise NotImplementedError

    def does(self, tick: int) -> tuple[int, int] | None:
        """Execute an action."""
        raise NotImplementedError


@dataclass
class Appends(Robot):
    """Sync, queue and streamed."""

    trigger: int = 0
    execute: int = 1
    hold: int = 0
    line: list[tuple[int, int]] = field(default_factory=list)
    not_before: dict[int, int] = field(default_factory=dict)
    expected: int = 0

    def wants(self, tick: int) -> bool:
        return self.expected == 0 and len(self.line) <= self.trigger

    def asks(self, request: int, tick: int) -> None:
        self.expected = self.execute

    def gets(self, request: int, index: int, now: int) -> None:
        if index < self.execute:
            self.line.append((request, index))
            self.expected -= 1
            if index == 0:
                self.not_before[request] = self.tick_of(now) + self.hold

    def does(self, tick: int) -> tuple[int, int] | None:
        if self.line and self.not_before[self.line[0][0]] <= tick:
            return self.line.pop(0)
        return None


@dataclass
class Replaces(Robot):
    """Actions have a tick on which they are due; whoever was observed last has the say."""

    execute: int = 1
    many: bool = False
    assumed: int = -1
    due: dict[int, tuple[int, int]] = field(default_factory=dict)
    began: int = 0
    next: int = 0
    here: int = -1

    def wants(self, tick: int) -> bool:
        count = len(self.log.asked_ns)
        if count == 0:
            return True
        if self.here < 0 or (not self.many and self.here < count - 1):
            return False
        return tick >= self.next

    def asks(self, request: int, tick: int) -> None:
        self.next = tick + self.execute

    def gets(self, request: int, index: int, now: int) -> None:
        if index or request < self.here:
            return
        self.here = request
        tick = self.tick_of(now)
        base = self.log.asked_ns[request] // self.period
        if request == 0:
            base = tick
            self.next = tick + self.execute
        elif self.assumed >= 0:
            base = tick - self.assumed
        self.due = {base + i: (request, i) for i in range(self.horizon)}

    def does(self, tick: int) -> tuple[int, int] | None:
        return self.due.get(tick)


@dataclass
class Aggregates(Robot):
    """Actions are due by the number that have been executed; a new one is blended into an old one."""

    trigger: int = 0
    weight: float = 1.0
    due: dict[int, tuple[tuple[int, int], dict[int, float]]] = field(default_factory=dict)
    done: int = 0
    observed: list[int] = field(default_factory=list)
    waiting: bool = False

    def wants(self, tick: int) -> bool:
        return not self.waiting and len(self.due) <= self.trigger

    def asks(self, request: int, tick: int) -> None:
        self.waiting = True
        self.observed.append(self.done)

    def gets(self, request: int, index: int, now: int) -> None:
        place = self.observed[request] + index
        self.waiting = False
        if place < self.done:
            return
        blend = {request: 1.0}
        if place in self.due:
            old = self.due[place][1]
            blend = {chunk: share * (1 - self.weight) for chunk, share in old.items()} | {request: self.weight}
        self.due[place] = (request, index), blend

    def does(self, tick: int) -> tuple[int, int] | None:
        if self.done not in self.due:
            self.log.blends.append({})
            return None
        action, blend = self.due.pop(self.done)
        self.log.blends.append(blend)
        self.done += 1
        return action
