"""When to ask: how many actions should be left, so that at most a share epsilon of the cycles stalls; modes that do.

A cycle's score is its latency: queue stalls where d > m, so the latency is the least trigger, in ns, from which on this
cycle does not stall. Choosing the r-th greatest of n recorded latencies is the conformal rule that stream-to-act is
calibrated with, and promises the same (`conformal`): with exchangeable latencies P(stall) <= (r + 1) / (n + 1).

Beside it stand rules to compare with: lerobot's all-time maximum, whose trigger only ever grows; the mean, that most
cycles near the mean exceed. ``most`` is the greatest trigger
there is, s for queue and H - s for the others: where the latency is above it no trigger helps, but slowing down does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from s2a_bench.policy.chunks import ChunkAction, ChunkStepper, ControlSetting, Ints, Mode
from s2a_bench.policy.chunks.closed import slow_down
from s2a_bench.policy.conformal import EPSILON, Calibration, Guarantee, Tracker, choose


@dataclass(frozen=True, slots=True)
class Trigger:
    """What a rule says: ask when ``ticks`` actions are left, with all actions ``beta`` times slower."""

    ticks: int
    beta: float = 1.0


class TriggerRule(Protocol):
    """A rule that learns each latency and says from which one on cycles may stall."""

    @property
    def latency_ns(self) -> float:
        """Return the latency to be ready for in the next cycle; infinity for as great a one as there can be."""

    def learn(self, latency_ns: int, *, stalled: bool) -> None:
        """Learn how long the answer took, and whether the robot stalled."""


def trigger(latency_ns: float, setting: ControlSetting, most: int) -> Trigger:
    """Return the least trigger that a latency does not stall with, and the slow-down where that is above ``most``.

    An infinite latency has the greatest trigger, and no slow-down. Raises ValueError for a ``most`` below 1 that a
    slow-down would be needed for.
    """
    if math.isinf(latency_ns):
        return Trigger(most)
    ticks = _ticks(latency_ns, setting)
    if ticks <= most:
        return Trigger(ticks)
    return Trigger(most, slow_down(latency_ns / 1e9, most, setting.period_ns / 1e9))


def calibrate(latency_ns: Ints, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence") -> Calibration:
    """Find the latency to be ready for, ``caution`` in ns, from n recorded ones of shape (n,); see the module's head.

    Raises UsageError where so few latencies allow no such promise.
    """
    return choose(latency_ns.astype(float), epsilon, guarantee)


@dataclass(slots=True)
class Maximum:
    """The greatest latency there has been, for ever: `max` of lerobot's latency tracker (policies/rtc).

    lerobot takes ceil(max / Delta t) for the delay that the model assumes; its trigger is a fixed number of actions.
    Here the same number is the trigger, the least that would have been safe so far.
    """

    latency_ns: float = 0.0

    def learn(self, latency_ns: int, *, stalled: bool) -> None:  # noqa: ARG002 - what counts is the latency
        self.latency_ns = max(self.latency_ns, float(latency_ns))


@dataclass(slots=True)
class Mean:
    """The mean of all latencies so far."""

    sum_ns: int = 0
    count: int = 0

    @property
    def latency_ns(self) -> float:
        return self.sum_ns / max(self.count, 1)

    def learn(self, latency_ns: int, *, stalled: bool) -> None:  # noqa: ARG002 - what counts is the latency
        self.sum_ns += latency_ns
        self.count += 1


@dataclass(slots=True)
class TrackedLatency:
    """The calibrated latency, tracked from cycle to cycle while the latencies drift: `conformal.Tracker`.

    Its bound on stalls, whatever the machine does, is about cycles that an infinite caution saves; here that is the
    greatest trigger, so latencies above it are not covered: they need a slow-down.
    """

    tracker: Tracker = field(repr=False)

    @staticmethod
    def begin(latency_ns: Iterable[float], epsilon: float = EPSILON, **options: Any) -> TrackedLatency:
        return TrackedLatency(Tracker(map(float, latency_ns), epsilon, **options))

    @property
    def latency_ns(self) -> float:
        return self.tracker.caution

    def learn(self, latency_ns: int, *, stalled: bool) -> None:
        self.tracker.learn(float(latency_ns), stalled=stalled)


def follow(rule: TriggerRule, latency_ns: Ints, setting: ControlSetting, most: int) -> Ints:
    """Return the trigger of each request where a rule learns every latency, shape (R,), after the cycle it decided.

    A trigger is at most ``most``, below s; the robot stalls for max(0, d - m) ticks.
    """
    triggers = np.empty(latency_ns.size, np.int64)
    for place, latency in enumerate(latency_ns.tolist()):
        triggers[place] = trigger(rule.latency_ns, setting, most).ticks
        rule.learn(latency, stalled=_ticks(latency, setting) > int(triggers[place]))
    return triggers


def _ticks(latency_ns: float, setting: ControlSetting) -> int:
    """Return d of a latency that need not be whole."""
    whole = math.ceil(latency_ns)
    return whole // setting.period_ns if setting.rounding == "floor" else -(-whole // setting.period_ns)


@dataclass(frozen=True, slots=True)
class Chosen(Mode):
    """How another mode acts whose trigger is chosen request by request."""

    mode: Mode

    @property
    def name(self) -> str:
        return self.mode.name

    @property
    def gap_ns(self) -> int:
        return self.mode.gap_ns

    @property
    def weight(self) -> float:
        return self.mode.weight


@dataclass(slots=True)
class ChosenStepper(ChunkStepper):
    """Tells a stepper the trigger before it is asked."""

    stepper: ChunkStepper
    choose: Callable[[], int]
    asked_at: int = 0
    triggers: list[int] = field(default_factory=list)

    def arrived(self, request: int, actions: int, tick: int) -> None:
        self.stepper.arrived(request, actions, tick)
        self.past = self.stepper.past

    def ask(self, tick: int) -> bool:
        self.stepper.trigger = self.choose()
        asks = self.stepper.ask(tick)
        if asks:
            self.asked_at = tick
            self.triggers.append(self.stepper.trigger)
        return asks

    def act(self, tick: int) -> ChunkAction | None:
        return self.stepper.act(tick)


@dataclass(frozen=True, slots=True)
class Varied(Chosen):
    """Ask for chunk r when ``triggers[r]`` actions are left, the last one ever after."""

    triggers: tuple[int, ...]

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        def choose() -> int:
            return self.triggers[min(len(stepper.triggers), len(self.triggers) - 1)]

        stepper = ChosenStepper(self.mode.stepper(setting), choose)
        return stepper


@dataclass(frozen=True, slots=True, eq=False)
class Learning(Chosen):
    """Ask when as few actions are left as a rule says, which ``begin`` makes.

    What `follow` says of recorded latencies, a robot does here as it goes. It sees whole ticks, and learns the middle
    of what a delay of d ticks can have been: no matter to a quantile or a maximum, and right for a mean.
    """

    begin: Callable[[], TriggerRule]

    def stepper(self, setting: ControlSetting) -> LearningStepper:
        rule, length = self.begin(), self.mode.execution_horizon(setting)

        def choose() -> int:
            return trigger(rule.latency_ns, setting, max(1, length - 1)).ticks

        return LearningStepper(self.mode.stepper(setting), choose, rule=rule, setting=setting, length=length)


@dataclass(slots=True, kw_only=True)
class LearningStepper(ChosenStepper):
    """A stepper whose rule learns the delay of every answer."""

    rule: TriggerRule
    setting: ControlSetting
    length: int
    """Actions of a chunk that are to be executed: when the last one is there the delay is known."""
    learnt: int = 0
    """Requests of which it is."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        ChosenStepper.arrived(self, request, actions, tick)
        if self.learnt <= request == len(self.triggers) - 1 and actions >= self.length:
            self.learnt = request + 1
            delay = tick - self.asked_at
            stalled = request > 0 and delay > self.triggers[-1]
            half_ticks = 2 * delay + (1 if self.setting.rounding == "floor" else -1)
            self.rule.learn(max(half_ticks, 0) * self.setting.period_ns // 2, stalled=stalled)
