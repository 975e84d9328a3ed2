"""When to ask: how many actions should be left, so that a share epsilon of the cycles at most stalls.

A cycle's score is its latency: queue stalls where d > m, so the latency is the least trigger, in ns, from which on this
cycle does not stall. Choosing the r-th greatest of n recorded latencies is the conformal rule that stream-to-act is
calibrated with, and promises the same (`conformal`): with exchangeable latencies P(stall) <= (r + 1) / (n + 1).

Beside it stand rules to compare with: lerobot's all-time maximum, whose trigger only ever grows; the mean, that most
cycles near the mean exceed; and an oracle that knows the distribution, not the draw. ``most`` is the greatest trigger
there is, s for queue and H - s for the others: where the latency is above it no trigger helps, but slowing down does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol

from s2a_bench.policy.chunks.closed import slow_down
from s2a_bench.policy.conformal import EPSILON, Calibration, Guarantee, Tracker, choose

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Ints, Setting

NS: Final = 1e9


@dataclass(frozen=True, slots=True)
class Trigger:
    """What a rule says: ask when ``ticks`` actions are left, with all actions ``beta`` times slower."""

    ticks: int
    beta: float = 1.0


class Rule(Protocol):
    """A rule that learns each latency and says from which one on cycles may stall."""

    @property
    def latency_ns(self) -> float:
        """Return the latency to be ready for in the next cycle; infinity for as great a one as there can be."""
        ...

    def learn(self, latency_ns: int, *, stalled: bool) -> None:
        """Learn how long the answer took, and whether the robot stalled."""
        ...


def trigger(latency_ns: float, setting: Setting, most: int) -> Trigger:
    """Return the least trigger that a latency does not stall with, and the slow-down where that is above ``most``.

    An infinite latency has the greatest trigger, and no slow-down. Raises ValueError for a ``most`` below 1 that a
    slow-down would be needed for.
    """
    if math.isinf(latency_ns):
        return Trigger(most)
    ticks = _ticks(latency_ns, setting)
    if ticks <= most:
        return Trigger(ticks)
    return Trigger(most, slow_down(latency_ns / NS, most, setting.period_ns / NS))


def calibrate(latency_ns: Ints, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence") -> Calibration:
    """Find the latency to be ready for, ``caution`` in ns, from n recorded ones of shape (n,); see the module's head.

    Raises UsageError where so few latencies allow no such promise.
    """
    return choose(latency_ns.astype(float), epsilon, guarantee)


def oracle_ticks(survival: Callable[[float], float], setting: Setting, epsilon: float = EPSILON) -> int:
    """Return the smallest safe trigger, the least m with P(d > m) <= ``epsilon``, from P(L > x) with x in s.

    It is ceil(F^-1(1 - epsilon) / Delta t) where actions leave at the start of their tick, and the floor of that where
    they leave at its end. Of a distribution without atoms.
    """
    later = 1 if setting.rounding == "floor" else 0

    def safe(ticks: int) -> bool:
        return survival((ticks + later) * setting.period_ns / NS) <= epsilon

    high = 1
    while not safe(high):
        high *= 2
    low = 0
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if safe(middle) else (middle + 1, high)
    return low


@dataclass(slots=True)
class Fixed:
    """One latency for ever: what a calibration or the oracle found."""

    latency_ns: float

    def learn(self, latency_ns: int, *, stalled: bool) -> None:
        """Learn nothing."""


@dataclass(slots=True)
class Maximum:
    """The greatest latency there has been, for ever: `max` of lerobot's latency tracker (policies/rtc).

    lerobot takes ceil(max / Delta t) for the delay that the model assumes; its trigger is a fixed number of actions.
    Here the same number is the trigger, the least that would have been safe so far.
    """

    latency_ns: float = 0.0

    def learn(self, latency_ns: int, *, stalled: bool) -> None:  # noqa: ARG002 - what counts is the latency
        """Keep the greatest."""
        self.latency_ns = max(self.latency_ns, float(latency_ns))


@dataclass(slots=True)
class Mean:
    """The mean of all latencies so far."""

    sum_ns: int = 0
    count: int = 0

    @property
    def latency_ns(self) -> float:
        """Return the mean."""
        return self.sum_ns / max(self.count, 1)

    def learn(self, latency_ns: int, *, stalled: bool) -> None:  # noqa: ARG002 - what counts is the latency
        """Count one more."""
        self.sum_ns += latency_ns
        self.count += 1


@dataclass(slots=True)
class Tracked:
    """The calibrated latency, tracked from cycle to cycle while the latencies drift: `conformal.Tracker`.

    Its bound on stalls, whatever the machine does, is about cycles that an infinite caution saves; here that is the
    greatest trigger, so latencies above it are not covered: they need a slow-down.
    """

    tracker: Tracker = field(repr=False)

    @staticmethod
    def begin(latency_ns: Iterable[float], epsilon: float = EPSILON, **options: Any) -> Tracked:
        """Begin with the latencies of a calibration; ``options`` are the tracker's."""
        return Tracked(Tracker(map(float, latency_ns), epsilon, **options))

    @property
    def latency_ns(self) -> float:
        """Return the latency that the recent ones exceed as often as they may."""
        return self.tracker.caution

    def learn(self, latency_ns: int, *, stalled: bool) -> None:
        """Move the level, and forget the oldest latency."""
        self.tracker.learn(float(latency_ns), stalled=stalled)


@dataclass(frozen=True, slots=True)
class Followed:
    """What a rule did cycle by cycle: arrays of shape (R,)."""

    trigger: Ints
    beta: Floats
    """By how much the actions left at the request were slowed down."""
    stall_ticks: Ints
    """In ticks of that length."""


def follow(rule: Rule, latency_ns: Ints, setting: Setting, most: int, slowest: float = 1.0) -> Followed:
    """Follow a robot whose rule learns every latency, shape (R,), after the cycle that it decided.

    Its trigger is at most ``most``, and where that is not enough its actions are up to ``slowest`` times slower
    (time-scaling; 1 for never). The stalls are those of `closed.queue_stall_ticks`, for ``most`` below s.
    """
    import numpy as np

    triggers, betas, stalls = np.empty(latency_ns.size, np.int64), np.ones(latency_ns.size), np.zeros_like(latency_ns)
    for place, latency in enumerate(latency_ns.tolist()):
        ready = rule.latency_ns
        chosen = Trigger(most, slowest) if math.isinf(ready) else trigger(ready, setting, most)
        slowed = setting
        if chosen.beta > 1 and slowest > 1:
            betas[place] = min(chosen.beta, slowest)
            slowed = setting.slowed(betas[place])
        triggers[place] = chosen.ticks
        stalls[place] = max(0, _ticks(latency, slowed) - chosen.ticks)
        rule.learn(latency, stalled=bool(stalls[place]))
    return Followed(triggers, betas, stalls)


def _ticks(latency_ns: float, setting: Setting) -> int:
    """Return d of a latency that need not be whole."""
    whole = math.ceil(latency_ns)
    return whole // setting.period_ns if setting.rounding == "floor" else -(-whole // setting.period_ns)
