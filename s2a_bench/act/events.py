"""What an executor is told: events, the feed that makes them of a stream's tokens, and inboxes on either clock."""

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
"""Why a stream can be trusted no longer."""


@dataclass(frozen=True, slots=True)
class Requested:
    """The plan has been asked for: the policy's time starts here."""

    at_ns: int


@dataclass(frozen=True, slots=True)
class TokenArrived:
    """A token arrived."""

    at_ns: int


@dataclass(frozen=True, slots=True)
class SkillArrived:
    """The next skill of the plan is certain, since the token that arrived at ``at_ns``."""

    at_ns: int
    call: Call


@dataclass(frozen=True, slots=True)
class StreamEnded:
    """The model has said all it had to say."""

    at_ns: int


@dataclass(frozen=True, slots=True)
class StreamBroke:
    """Nothing that follows can be trusted."""

    at_ns: int
    fault: Fault
    why: str


@dataclass(frozen=True, slots=True)
class SkillOver:
    """The skill of that number (from 0) has ended by itself; ``error`` is empty if it went well."""

    at_ns: int
    index: int
    error: str = ""


@dataclass(frozen=True, slots=True)
class AbortRequested:
    """Somebody wants the robot to stop."""

    at_ns: int
    why: str = "asked to stop"


Event: TypeAlias = Requested | TokenArrived | SkillArrived | StreamEnded | StreamBroke | SkillOver | AbortRequested


class PlanFeed:
    """Told what a stream brings, by the thread that reads it: every executor that follows it is told the same."""

    def __init__(self, parser: Parser, tell: Callable[[Event], None]) -> None:
        """Read with ``parser``, a new one for every answer; ``tell`` delivers each event, as `EventQueue.put`."""
        self._parser = parser
        self._tell = tell
        self.token_ns: list[int] = []
        self.requested_ns: int | None = None

    def requested(self, at_ns: int) -> None:
        self.requested_ns = at_ns
        self._tell(Requested(at_ns))

    def token(self, text: str | bytes, at_ns: int) -> None:
        """Take a token that arrived at ``at_ns``: the skills that it completes arrived then too."""
        self.token_ns.append(at_ns)
        self._tell(TokenArrived(at_ns))
        self._parsed(self._parser.feed(text), at_ns)

    def ended(self, at_ns: int) -> None:
        self._parsed(self._parser.close(), at_ns)
        self._tell(StreamEnded(at_ns))

    def broke(self, why: str, at_ns: int, fault: Fault = "stream-error") -> None:
        self._tell(StreamBroke(at_ns, fault, why))

    def _parsed(self, events: Sequence[PlanEvent], at_ns: int) -> None:
        for event in events:
            if isinstance(event, SkillParsed):
                self._tell(SkillArrived(at_ns, event.call))
            else:
                self.broke(f"line {event.line + 1} ({event.problem}): {event.why}", at_ns, "invalid-line")


class EventQueue(Protocol):
    """Events on their way to one executor."""

    def put(self, event: Event) -> None:
        """Deliver an event, from any thread."""
        ...

    def wait(self, until_ns: int | None) -> list[Event]:
        """Wait for events until then (None: for ever) and return those there are, in order; none at that time."""
        ...


class LiveInbox:
    """Waits on CLOCK_MONOTONIC, asleep."""

    def __init__(self) -> None:
        self._events: SimpleQueue[Event] = SimpleQueue()

    def put(self, event: Event) -> None:
        self._events.put(event)

    def wait(self, until_ns: int | None) -> list[Event]:
        found: list[Event] = []
        while not found and (until_ns is None or now_ns() < until_ns):
            with suppress(Empty):  # a timeout is a little early where the system's unit is coarser
                found.append(self._events.get(timeout=None if until_ns is None else max(until_ns - now_ns(), 0) / 1e9))
        while not self._events.empty():  # nobody else takes from it
            found.append(self._events.get())
        return found


class ScriptedInbox:
    """Knows beforehand what comes when; waiting moves a virtual clock. What is put is delivered at its own time."""

    def __init__(self, clock: VirtualClock, script: Iterable[Event] = ()) -> None:
        """Take the events in order of time; at the same instant in the order given."""
        self._clock = clock
        self._order = count()
        self._events: list[tuple[int, int, Event]] = []
        for event in script:
            self.put(event)

    def put(self, event: Event) -> None:
        """Deliver an event at its time, or now if that is past."""
        heapq.heappush(self._events, (event.at_ns, next(self._order), event))

    def wait(self, until_ns: int | None) -> list[Event]:
        """Jump to the next event, or to ``until_ns``; raises RuntimeError where nothing will ever happen."""
        if not self._events and until_ns is None:
            raise RuntimeError("nothing will ever happen: the executor would wait for ever")
        if not self._events or (until_ns is not None and until_ns < self._events[0][0]):
            self._clock.sleep_until_ns(until_ns or 0)
            return []
        self._clock.sleep_until_ns(self._events[0][0])
        found = []
        while self._events and self._events[0][0] <= self._clock.now_ns():
            found.append(heapq.heappop(self._events)[2])
        return found
