"""The clock of a session's server on another host: exchanges beside the requests, and reports on this host's clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import RequestFailed, S2AError
from s2a_bench.harness.clocks import Bounded, Exchange, Offset
from s2a_bench.machine.clocks import FRESH_NS, wall_clock
from s2a_bench.trace import Trace
from s2a_bench.transport.serving import REALTIME_ERROR_MS, REALTIME_MS

FIRST: Final = 20
"""Exchanges when the clock is met."""
FIRST_PAUSE_NS: Final = 50_000_000
"""Time between these: a second together, which bounds the clocks' rate."""
BURST: Final = 5
FLOAT_NS: Final = 1000
"""What a wall clock loses as a float of ms."""
WANDER: Final = 1e-5
"""Rate at which a disciplined wall clock may leave its bound while a reading is fresh."""
PERIOD_NS: Final = 10**9
"""Between requests, one burst of exchanges in this time at most."""


@dataclass(frozen=True, slots=True)
class Joined:
    """How far the stamps of a report may be off, once they are on this host's clock."""

    error_ns: int
    """From the last byte packed to the first piece, either way."""
    early_ns: int
    late_ns: int
    """From the reception of the frame to the last piece: how much earlier and later the true times may be."""


class RemoteClock:
    """The offset of one server's clock; nothing is exchanged before `join` has met it."""

    def __init__(self, exchange: Callable[[str], Trace], offsets: dict[str, Offset] | None, system: str = "") -> None:
        """``exchange`` makes a request for its marks alone; ``offsets``, by clock, are those that others estimate too.

        Without ``offsets`` nothing is exchanged, and the requests alone bound the offset, more widely.

        ``exchange`` raises S2AError; its argument is ``system``, one of `machine.clocks.COMMANDS` or "", where the
        server's wall clock is wanted.
        """
        self._exchange, self._system = exchange, system
        self._exchanges = offsets is not None
        self._offsets = {} if offsets is None else offsets
        self._id = ""
        self._last_ns = 0

    def refresh(self) -> None:
        """Exchange time stamps, if the server's clock is another and a second has passed since the last time."""
        if self._exchanges and self._id and now_ns() - self._last_ns > PERIOD_NS:
            self._burst(BURST, 0)

    def join(self, trace: Trace, last_ns: int) -> Joined:
        """Put a request's report on this host's clock, at the middle of the offset's interval.

        The last piece was seen at ``last_ns``. Raises ClockMoved, and RequestFailed for a report without marks.
        """
        own, remote = Exchange.of(trace), trace.remote
        assert remote is not None  # noqa: S101 - for mypy
        met, self._id = remote.clock == self._id, remote.clock
        offset = self._offsets.setdefault(self._id, Offset())
        offset.add(own)
        if met:
            self.refresh()
        elif self._exchanges:
            self._burst(FIRST, FIRST_PAUSE_NS)
            if self._system:
                self._compare_wall_clocks()
        early_ns = min((stamp - own.upper[1] for _, stamp in remote.frame_marks), default=own.sent_ns)
        near = offset.over(own.sent_ns, own.seen_ns)
        whole = near | offset.over(min(early_ns, own.sent_ns), last_ns)
        trace.remote = remote.shifted(near.middle_ns)
        return Joined(near.half_ns, whole.hi_ns - near.middle_ns, near.middle_ns - whole.lo_ns)

    def _burst(self, count: int, pause_ns: int) -> None:
        clock = SystemClock()
        offset = self._offsets[self._id]
        with suppress(S2AError):  # the next request meets what is wrong, and reports it
            for _ in range(count):
                offset.add(Exchange.of(self._exchange("")))
                clock.sleep_until_ns(now_ns() + pause_ns)
            if self._system and count == BURST:
                self._compare_wall_clocks()
        self._last_ns = now_ns()

    def _compare_wall_clocks(self) -> None:
        """Bound the offset by what both hosts know of their wall clocks' errors; raises S2AError."""
        trace, ours = self._exchange(self._system), wall_clock(self._system)
        if not trace.facts.keys() >= {REALTIME_MS, REALTIME_ERROR_MS}:
            raise RequestFailed(f"`clock` {self._system}: the server does not tell its wall clock; leave it out")
        theirs_ns, error_ns = (round(trace.facts[name] * 1e6) for name in (REALTIME_MS, REALTIME_ERROR_MS))
        sent_ns, seen_ns = Exchange.of(trace).sent_ns, now_ns()
        error_ns += ours.error_ns + FLOAT_NS + round(2 * FRESH_NS * WANDER)
        self._offsets[self._id].add(Bounded(sent_ns, seen_ns, ours.offset_ns - theirs_ns, error_ns))
