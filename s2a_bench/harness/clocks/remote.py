"""The clock of a session's server on another host: exchanges beside the requests, and reports on this host's clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import S2AError
from s2a_bench.harness.clocks import Exchange, Offset
from s2a_bench.trace import Trace

FIRST: Final = 20
"""Exchanges when the clock is met."""
FIRST_PAUSE_NS: Final = 50_000_000
"""Time between these: a second together, which bounds the clocks' rate."""
BURST: Final = 5
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

    def __init__(self, exchange: Callable[[], Trace], offsets: dict[str, Offset]) -> None:
        """``exchange`` makes a request for its marks alone; ``offsets``, by clock, are those that others estimate too.

        ``exchange`` raises S2AError.
        """
        self._exchange, self._offsets = exchange, offsets
        self._id = ""
        self._last_ns = 0

    def refresh(self) -> None:
        """Exchange time stamps, if the server's clock is another and a second has passed since the last time."""
        if self._id and now_ns() - self._last_ns > PERIOD_NS:
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
        else:
            self._burst(FIRST, FIRST_PAUSE_NS)
        early_ns = min((stamp - own.upper[1] for _, stamp in remote.frame_marks), default=own.sent_ns)
        near = offset.over(own.sent_ns, own.seen_ns)
        whole = near | offset.over(min(early_ns, own.sent_ns), last_ns)
        trace.remote = remote.shifted(near.middle_ns)
        return Joined(near.half_ns, whole.hi_ns - near.middle_ns, near.middle_ns - whole.lo_ns)

    def _burst(self, count: int, pause_ns: int) -> None:
        clock = SystemClock()
        with suppress(S2AError):  # the next request meets what is wrong, and reports it
            for _ in range(count):
                self._offsets[self._id].add(Exchange.of(self._exchange()))
                clock.sleep_until_ns(now_ns() + pause_ns)
        self._last_ns = now_ns()
