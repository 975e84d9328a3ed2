"""The offset of another host's clock, as an interval at each instant, from exchanges of four time stamps.

An exchange leaves this host at t1 and its answer arrives at t4, both on this host's clock; the other host receives it
at t2 and answers at t3, on its own. Delays are not negative, so t3 - t4 <= offset(t4) and offset(t1) <= t2 - t1,
whatever the asymmetry. Within `WINDOW_NS` the offset is a line a + b t, below every upper point and above every lower
one; the possible (a, b) are a polygon, and the interval at t is the least and the greatest a + b t over it (Moon,
Skelly, Towsley, Infocom 1999; Zhang, Liu, Xia, Infocom 2002). If a clock was stepped or slewed, no line is left: that
is an error and never widened away.

`RemoteClock` makes exchanges beside a session's requests, and puts its server's reports on this host's clock. With
`--clock` both hosts also ask chrony or PTP for the error of their wall clocks, which bounds the offset, too.
"""

from __future__ import annotations

import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise, product
from math import ceil, floor
from platform import node
from typing import Any, Final, TypeAlias

import numpy as np

from s2a_bench.clock import SystemClock, now_ns, realtime_offset_ns
from s2a_bench.errors import ClockMoved, RequestFailed, S2AError
from s2a_bench.machine.clocks import REALTIME_ERROR_MS, REALTIME_MS, WALL_CLOCKS, WallClock
from s2a_bench.trace import Trace
from s2a_bench.transport.surroundings import Joined

WINDOW_NS: Final = 60 * 10**9
KEPT: Final = 2000
"""Most exchanges that count: a fast client's windows are shorter, so that an interval is found in a few ms."""
RATE: Final = 0.1
"""Limit on the relative rate of two clocks: chrony slews by at most 100,000 ppm."""
ROUNDING_NS: Final = 1
"""Added on both sides, for what floats lose."""
VERTICES: Final = 100
"""Most vertices of a hull that count: without some the interval is wider, never wrong."""
FIRST: Final = 20
"""Exchanges when the clock is met."""
FIRST_PAUSE_NS: Final = 50_000_000
"""Time between these: a second together, which bounds the clocks' rate."""
BURST: Final = 5
FLOAT_NS: Final = 1000
"""The rounding of a wall clock as a float of ms."""
WANDER: Final = 1e-5
"""Rate at which a disciplined wall clock may leave its bound while a reading is fresh."""
PERIOD_NS: Final = 10**9
"""The shortest time between two bursts of exchanges, between requests."""
PATIENCE_S: Final = 3.0
"""Most time in which a program tells the wall clock's error."""
FRESH_NS: Final = 10**9
"""A reading of the wall clock is used again for so long, whatever clients request."""

Point: TypeAlias = tuple[int, int]
"""Time on this host's clock, and a bound of the offset there, in ns."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """The four time stamps t1 to t4."""

    sent_ns: int
    received_ns: int
    answered_ns: int
    seen_ns: int

    @staticmethod
    def of(trace: Trace) -> Exchange:
        """Read a request as an exchange, last byte packed to first piece seen; raises RequestFailed without marks."""
        remote = trace.remote
        if remote is None or not remote.marks:
            raise RequestFailed("the server reported no marks, so that its clock cannot be compared with this host's")
        return Exchange(trace.marks[-2][1], remote.marks[0][1], remote.marks[-1][1], trace.marks[-1][1])

    @staticmethod
    def bounded(at_ns: int, middle_ns: int, error_ns: int) -> Exchange:
        """Return an exchange in no time, for an offset as both wall clocks and the bounds of their errors give it."""
        return Exchange(at_ns, at_ns + middle_ns + error_ns, at_ns + middle_ns - error_ns, at_ns)

    @property
    def upper(self) -> Point:
        return self.sent_ns, self.received_ns - self.sent_ns

    @property
    def lower(self) -> Point:
        return self.seen_ns, self.answered_ns - self.seen_ns


@dataclass(frozen=True, slots=True)
class Interval:
    """An offset lies within it, both ends included."""

    lo_ns: int
    hi_ns: int

    def __or__(self, other: Interval) -> Interval:
        return Interval(min(self.lo_ns, other.lo_ns), max(self.hi_ns, other.hi_ns))


class Offset:
    """The offset of another clock from this host's, the other minus this one."""

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=KEPT)

    def add(self, exchange: Exchange) -> None:
        """Add an exchange, or what the wall clocks say, on any thread."""
        self._exchanges.append(exchange)

    def over(self, *times_ns: int) -> Interval:
        """Return an interval that holds the offset at these times, and between them; raises ClockMoved if none can."""
        return reduce(Interval.__or__, map(self._at, times_ns))

    def _at(self, at_ns: int) -> Interval:
        last_ns = self._exchanges[-1].seen_ns
        near = self._until(min(at_ns + WINDOW_NS // 2, last_ns))
        return interval_at(at_ns, near or self._until(last_ns))  # a frame may be far older than all exchanges

    def _until(self, end_ns: int) -> list[Exchange]:
        """Return the exchanges within `WINDOW_NS` before a time."""
        return [e for e in [*self._exchanges] if e.seen_ns >= end_ns - WINDOW_NS and e.sent_ns <= end_ns]


def interval_at(at_ns: int, exchanges: Sequence[Exchange]) -> Interval:
    """Return the interval of the offset at an instant; raises ClockMoved if no line passes between the exchanges.

    The least and the greatest value are those of vertices of the polygon: of lines through two of the bounds, or
    through one at the limit of `RATE`.
    """
    base_ns = exchanges[0].upper[1]
    upper = _lower_hull((time - at_ns, bound - base_ns) for time, bound in (each.upper for each in exchanges))
    mirrored = _lower_hull((time - at_ns, base_ns - bound) for time, bound in (each.lower for each in exchanges))
    lower = [(time, -bound) for time, bound in mirrored]
    above, below = np.array(upper, np.float64), np.array(lower, np.float64)
    pairs = [*pairwise(upper), *pairwise(lower), *product(upper, lower)]
    lines = [(one, (other[1] - one[1]) / (other[0] - one[0])) for one, other in pairs if one[0] != other[0]]
    lines += [(point, rate) for point in (*upper, *lower) for rate in (-RATE, RATE)]
    corners = np.array([(bound - rate * time, rate) for (time, bound), rate in lines if abs(rate) <= RATE])
    at, rate = corners[:, :1], corners[:, 1:]
    over, under = at + rate * above[:, 0] - above[:, 1], below[:, 1] - at - rate * below[:, 0]
    beyond = np.maximum(over.max(axis=1), under.max(axis=1))
    if beyond.min() > ROUNDING_NS / 2:
        raise ClockMoved(
            f"the clocks of the two hosts moved against each other by about {2 * beyond.min() / 1e6:.2g} ms within "
            f"{WINDOW_NS // 10**9} s: one was stepped or slewed, and one-way times cannot be told; wait until NTP has "
            "settled (chronyc waitsync), or stop it for the run, and leave `clock` out"
        )
    possible = at[beyond <= ROUNDING_NS / 2]
    return Interval(base_ns + floor(possible.min()) - ROUNDING_NS, base_ns + ceil(possible.max()) + ROUNDING_NS)


def _lower_hull(points: Iterable[Point]) -> list[Point]:
    """Return vertices of the lower convex hull (Andrew's monotone chain), at most `VERTICES`."""
    hull: list[Point] = []
    for time, bound in sorted(points):
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (time - hull[-2][0]) >= (bound - hull[-2][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            hull.pop()
        hull.append((time, bound))
    return hull[:: len(hull) // VERTICES + 1]


class RemoteClock:
    """The offset of one server's clock; nothing is exchanged before `join` has met it."""

    def __init__(self, exchange: Callable[[str], Trace], offsets: dict[str, Any] | None, system: str = "") -> None:
        """``exchange`` makes a request for its marks alone; ``offsets``, by clock, are those that others estimate too.

        Without ``offsets`` nothing is exchanged: the requests alone bound the offset, more widely. ``exchange`` raises
        S2AError; its argument is ``system``, one of `WALL_CLOCKS`, where the server's wall clock is wanted, else "".
        """
        self._exchange, self._system = exchange, system
        self._exchanges = offsets is not None
        self._offsets: dict[str, Offset] = {} if offsets is None else offsets
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
        middle_ns = (near.lo_ns + near.hi_ns) // 2  # its farther end is the upper one
        trace.remote = remote.shifted(middle_ns)
        return Joined(near.hi_ns - middle_ns, whole.hi_ns - middle_ns, middle_ns - whole.lo_ns)

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
        trace, ours = self._exchange(self._system), WALL_CLOCKS[self._system]()
        if not trace.facts.keys() >= {REALTIME_MS, REALTIME_ERROR_MS}:
            raise RequestFailed(f"`clock` {self._system}: the server does not tell its wall clock; leave it out")
        theirs_ns, error_ns = (round(trace.facts[name] * 1e6) for name in (REALTIME_MS, REALTIME_ERROR_MS))
        error_ns += ours.error_ns + FLOAT_NS + round(2 * FRESH_NS * WANDER)
        self._offsets[self._id].add(Exchange.bounded(now_ns(), ours.offset_ns - theirs_ns, error_ns))


@dataclass(slots=True)
class ClockProgram:
    """A program that knows the error of the wall clock."""

    system: str
    command: tuple[str, ...]
    error_s: Callable[[str], float]
    """Reads the error off its output."""
    last: WallClock | None = None

    def __call__(self) -> WallClock:
        """Read the wall clock, and ask for its error; raises RequestFailed if that is not told."""
        if self.last and now_ns() - self.last.read_ns < FRESH_NS:
            return self.last
        try:
            done = subprocess.run(  # noqa: S603 - one of two fixed commands
                self.command, capture_output=True, text=True, timeout=PATIENCE_S, check=True
            )
            error_s = self.error_s(done.stdout)
        except (OSError, subprocess.SubprocessError, ValueError, LookupError) as error:
            raise RequestFailed(
                f"`clock` {self.system}: '{' '.join(self.command)}' tells no bound on the host {node()}: {error}"
            ) from error
        began_ns, offset_ns = now_ns(), realtime_offset_ns()
        ended_ns = now_ns()
        self.last = WallClock(offset_ns, round(error_s * 1e9) + ended_ns - began_ns, ended_ns)
        return self.last


def chrony_error_s(csv: str) -> float:
    """Return |offset| + root dispersion + root delay / 2 of ``chronyc -c tracking``, RFC 5905's root distance."""
    fields = csv.strip().split(",")
    if fields[13] != "Normal":
        raise ValueError(f"chronyd is not synchronised ({fields[13]})")
    return abs(float(fields[4])) + float(fields[11]) + float(fields[10]) / 2


def ptp_error_s(text: str) -> float:
    """Return |offset| + mean path delay of pmc's CURRENT_DATA_SET: the path may be as asymmetric as it is long."""
    words = text.split()
    offset_ns, delay_ns = (float(words[words.index(name) + 1]) for name in ("offsetFromMaster", "meanPathDelay"))
    return (abs(offset_ns) + delay_ns) / 1e9


CHRONY: Final = ClockProgram("chrony", ("chronyc", "-c", "tracking"), chrony_error_s)
PTP: Final = ClockProgram("ptp", ("pmc", "-u", "-b", "0", "GET CURRENT_DATA_SET"), ptp_error_s)
