"""The search for the largest fleet within a limit: which fleets to try, when one is decided, and what follows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from s2a_bench.plugins.chunks.capacity.config import Limit
from s2a_bench.plugins.chunks.capacity.metrics import FleetMetrics, RobotTrace, cycle_ns, flagged, share_interval
from s2a_bench.plugins.chunks.capacity.rows import Verdict
from s2a_bench.plugins.chunks.modes import Flags, Ints


@dataclass(frozen=True, slots=True)
class Tried:
    robots: int
    verdict: Verdict
    within: bool
    """Whether the value itself keeps to the limit, decided or not."""
    clean: bool = True
    """Whether the generator was in time; if not, the fleet is not counted as measured."""


@dataclass(frozen=True, slots=True)
class Knee:
    """The largest fleet within the limit, surely ``low`` to ``high`` robots; None: no fleet was surely too large."""

    robots: int
    low: int
    high: int | None


def search(numbers: Sequence[int], attempt: Callable[[int], Tried], tried: dict[int, Tried], *, bisects: bool) -> None:
    """Try one robot, then fleets of ``numbers`` robots, ascending, each once; ``tried`` gets them as they are tried.

    With ``bisects`` the first that exceeds the limit ends that, and the numbers between it and the one before are
    bisected.
    """

    def fits(number: int) -> bool:
        if number not in tried:
            tried[number] = attempt(number)
        return tried[number].within

    if not fits(1) and bisects:
        return
    good = numbers[0] - 1
    for number in numbers:
        if fits(number):
            good = number
        elif bisects:
            bad = number
            break
    else:
        return
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)


def knee(tried: Iterable[Tried]) -> Knee | None:
    """Return the knee of fleets, taking a larger fleet to fare no better; None without a measurement."""
    clean = [each for each in tried if each.clean]
    if not clean:
        return None
    broken = min((each.robots for each in clean if not each.within), default=None)
    above = min((each.robots for each in clean if each.verdict == "above"), default=None)

    def largest(fit: Callable[[Tried], bool], before: int | None) -> int:
        return max((each.robots for each in clean if fit(each) and (before is None or each.robots < before)), default=0)

    robots = largest(lambda each: each.within, broken)
    low = largest(lambda each: each.verdict == "below", above)
    return Knee(robots, min(low, robots), None if above is None else max(above - 1, robots))


@dataclass(slots=True)
class Judge:
    """Judges the fleets of a cell by a limit, one robot alone first."""

    limit: Limit | None
    beyond: bool
    """Whether only stalls beyond those of one robot alone count, as in a mode that blocks."""
    settle_ns: int
    confidence: float
    alone: float | None = None
    """Share of stalled ticks of one robot alone, taken as known."""

    def __call__(
        self, fleet: FleetMetrics, traces: Sequence[RobotTrace], *, first: bool = False
    ) -> tuple[Verdict, bool]:
        """Return where a fleet's interval lies against the limit, and whether its value keeps to it.

        The ``first`` is one robot alone. It stalls no more than itself, but may leave no room for the limit.
        """
        limit = self.limit
        if first:
            self.alone = fleet.stalled
        if limit is None:
            return "none", True
        if limit.column == "stalled":
            share, low, high = fleet.stalled, fleet.stalled_low, fleet.stalled_high
            if share is None or low is None or high is None:
                return "undecided", False
            if self.beyond and first:
                return ("below", True) if limit.share + share < 1 else ("above", False)
            alone_share = (self.alone or 0.0) if self.beyond else 0.0
            low, high, share = low - alone_share, high - alone_share, share - alone_share
        else:
            at_ns, robots, above = above_limit(limit, traces, self.settle_ns)
            if not above.size:
                return "undecided", False
            low, high = share_interval(above, at_ns, robots, cycle_ns(traces), self.confidence)
            share = float(above.mean())
        within = share <= limit.share
        if high <= limit.share:
            return "below", within
        return "above" if low > limit.share else "undecided", within


def above_limit(limit: Limit, traces: Sequence[RobotTrace], settle_ns: int) -> tuple[Ints, Ints, Flags]:
    """Return time, robot and whether above the limit, of the values of a limit on latencies or ages: shapes (K,).

    A request without an answer counts once it waits for longer than the limit.
    """

    def ages_above(trace: RobotTrace) -> tuple[Ints, Flags] | None:
        if trace.ticks is None:
            return None
        period_ns = (trace.end_ns - trace.start_ns) / max(1, trace.ticks.age.size)
        acted = np.flatnonzero(trace.ticks.age >= 0)
        return (acted * period_ns).astype(np.int64), trace.ticks.age[acted] * period_ns > limit.value

    def latencies_above(trace: RobotTrace) -> tuple[Ints, Flags] | None:
        taken_ns = trace.first_ns if limit.column.startswith("ttft") else trace.arrival_ns
        if taken_ns is None:
            return None
        exceeds = np.where(taken_ns < 0, trace.end_ns - trace.request_ns, taken_ns) > limit.value
        counts = (taken_ns >= 0) | exceeds
        return (trace.request_ns - trace.start_ns)[counts], exceeds[counts]

    return flagged(traces, settle_ns, ages_above if limit.column.startswith("age") else latencies_above)
