"""Events of an executor, the feed that makes them from a stream's tokens, and their inbox."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from queue import Empty, SimpleQueue
from typing import Literal, Protocol, TypeAlias

from s2a_bench.clock import VirtualClock, now_ns
from s2a_bench.plan import Call, Parser, SkillParsed
from s2a_bench.plan import Event as PlanEvent

Fault: TypeAlias = Literal["stream-error", "silence", "invalid-line"]
"""Reasons to stop trusting a stream."""


@dataclass(frozen=True, slots=True)
class Requested:
    """The plan has been requested: the policy's time starts here."""

    at_ns: int


@dataclass(frozen=True, slots=True)
class TokenArrived:
    at_ns: int


@dataclass(frozen=True, slots=True)
class SkillArrived:
    """The next skill of the plan is certain, since the token that arrived at ``at_ns``."""

    at_ns: int
    call: Call


@dataclass(frozen=True, slots=True)
class StreamEnded:
    at_ns: int


@dataclass(frozen=True, slots=True)
class StreamBroke:
    """The rest of the stream cannot be trusted."""

    at_ns: int
    fault: Fault
    why: str


@dataclass(frozen=True, slots=True)
class SkillOver:
    """The skill of that number (from 0) has ended by itself; ``error`` is empty on success."""

    at_ns: int
    index: int
    error: str = ""


@dataclass(frozen=True, slots=True)
class AbortRequested:
    at_ns: int
    why: str = "abort requested"


Event: TypeAlias = Requested | TokenArrived | SkillArrived | StreamEnded | StreamBroke | SkillOver | AbortRequested


class PlanFeed:
    """Turns a stream into events, on the thread that reads it.

    ``parser`` is a new one for every answer; ``put`` delivers an event to every executor, as `EventQueue.put`.
    """

    def __init__(self, parser: Parser, put: Callable[[Event], None]) -> None:
        self._parser = parser
        self._put = put
        self.token_ns: list[int] = []
        self.requested_ns: int | None = None

    def requested(self, at_ns: int) -> None:
        self.requested_ns = at_ns
        self._put(Requested(at_ns))

    def token(self, text: str | bytes, at_ns: int) -> None:
        self.token_ns.append(at_ns)
        self._put(TokenArrived(at_ns))
        self._parsed(self._parser.feed(text), at_ns)

    def ended(self, at_ns: int) -> None:
        self._parsed(self._parser.close(), at_ns)
        self._put(StreamEnded(at_ns))

    def broke(self, why: str, at_ns: int, fault: Fault = "stream-error") -> None:
        self._put(StreamBroke(at_ns, fault, why))

    def _parsed(self, events: Sequence[PlanEvent], at_ns: int) -> None:
        for event in events:
            if isinstance(event, SkillParsed):
                self._put(SkillArrived(at_ns, event.call))
            else:
                self.broke(f"line {event.line + 1} ({event.problem}): {event.why}", at_ns, "invalid-line")


class EventQueue(Protocol):
    def put(self, event: Event) -> None:
        """Deliver an event, from any thread."""

    def wait(self, until_ns: int | None) -> list[Event]:
        """Wait for events until ``until_ns`` (None: for ever) and return them in order; an empty list at that time."""


class LiveInbox:
    """An inbox on CLOCK_MONOTONIC, which sleeps while it waits."""

    def __init__(self) -> None:
        self._events: SimpleQueue[Event] = SimpleQueue()

    def put(self, event: Event) -> None:
        self._events.put(event)

    def wait(self, until_ns: int | None) -> list[Event]:
        events: list[Event] = []
        while not events and (until_ns is None or now_ns() < until_ns):
            with suppress(Empty):  # a timeout may be early by the system's time unit
                events.append(self._events.get(timeout=None if until_ns is None else max(until_ns - now_ns(), 0) / 1e9))
        while not self._events.empty():  # this is the only reader
            events.append(self._events.get())
        return events


class VirtualInbox:
    """An inbox on a virtual clock, which waiting moves; events arrive at their times, then in the order of `put`."""

    def __init__(self, clock: VirtualClock, events: Iterable[Event] = ()) -> None:
        self._clock = clock
        self._order = count()
        self._events: list[tuple[int, int, Event]] = []
        for event in events:
            self.put(event)

    def put(self, event: Event) -> None:
        heapq.heappush(self._events, (event.at_ns, next(self._order), event))

    def wait(self, until_ns: int | None) -> list[Event]:
        """Jump to the next event, or to ``until_ns``; raises RuntimeError without either."""
        next_ns = self._events[0][0] if self._events else until_ns
        if next_ns is None:
            raise RuntimeError("nothing will ever happen: the executor would wait for ever")
        self._clock.sleep_until_ns(next_ns if until_ns is None else min(next_ns, until_ns))
        events = []
        while self._events and self._events[0][0] <= self._clock.now_ns():
            events.append(heapq.heappop(self._events)[2])
        return events
