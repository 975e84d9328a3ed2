"""Triggers: the number of actions left at a request for which at most a share epsilon of the cycles stalls.

A cycle's score is its latency: queue stalls if d > m, so the latency is the least trigger, in ns, without a stall in
this cycle. Choosing the r-th greatest of n recorded latencies is the conformal rule that calibrates stream-to-act, with
the same bound (`conformal`): for exchangeable latencies P(stall) <= (r + 1) / (n + 1). `conformal.Tracker` follows it
from cycle to cycle while the latencies drift. Its infinite caution is the greatest trigger here, so its bound on stalls
does not cover latencies above that one: they need a slow-down.

Rules for comparison are lerobot's all-time maximum, whose trigger only grows, and the mean. ``most`` is the greatest
possible trigger, s for queue and H - s for the others: above it no trigger helps, only slower actions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from s2a_bench.plugins.chunks.modes import ChunkAction, ChunkStepper, ControlSetting, Ints, Mode
from s2a_bench.plugins.chunks.modes.closed import slow_down
from s2a_bench.policy.conformal import EPSILON, Calibration, Guarantee, choose


@dataclass(frozen=True, slots=True)
class Trigger:
    """Request a chunk when ``ticks`` actions are left, with all actions ``beta`` times slower."""

    ticks: int
    beta: float = 1.0


class TriggerRule(Protocol):
    """A rule that learns from each latency and limits the next one."""

    @property
    def caution(self) -> float:
        """Return the greatest latency without a stall in the next cycle, in ns; infinity: the greatest trigger."""

    def learn(self, score: int, /, *, stalled: bool) -> None:
        """Learn from the latency of an answer, in ns, and from whether the robot stalled."""


def trigger(latency_ns: float, setting: ControlSetting, most: int) -> Trigger:
    """Return the least trigger without a stall at a latency, and the slow-down if that exceeds ``most``.

    An infinite latency gives the greatest trigger and no slow-down. Raises ValueError if a slow-down is needed and
    ``most`` is below 1.
    """
    if math.isinf(latency_ns):
        return Trigger(most)
    ticks = setting.delay(math.ceil(latency_ns))
    if ticks <= most:
        return Trigger(ticks)
    return Trigger(most, slow_down(latency_ns / 1e9, most, setting.period_ns / 1e9))


def greatest_trigger(mode: Mode, setting: ControlSetting) -> int:
    """Return the trigger above which none helps queue."""
    return max(1, mode.execution_horizon(setting) - 1)


def calibrate(latency_ns: Ints, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence") -> Calibration:
    """Find the latency limit, ``caution`` in ns, from latencies of shape (n,); raises UsageError for too few."""
    return choose(latency_ns.astype(float), epsilon, guarantee, latency_ns.astype(float))


@dataclass(slots=True)
class Maximum:
    """The greatest latency so far: `max` of lerobot's latency tracker (policies/rtc).

    In lerobot ceil(max / Delta t) is the delay that the model assumes, and the trigger is fixed. Here the same number
    is the trigger, the least that would have been safe so far.
    """

    caution: float = 0.0

    def learn(self, latency_ns: int, /, *, stalled: bool) -> None:  # noqa: ARG002 - only the latency matters
        self.caution = max(self.caution, float(latency_ns))


@dataclass(slots=True)
class Mean:
    """The mean of all latencies so far."""

    sum_ns: int = 0
    count: int = 0

    @property
    def caution(self) -> float:
        return self.sum_ns / max(self.count, 1)

    def learn(self, latency_ns: int, /, *, stalled: bool) -> None:  # noqa: ARG002 - only the latency matters
        self.sum_ns += latency_ns
        self.count += 1


def follow(rule: TriggerRule, latency_ns: Ints, setting: ControlSetting, most: int) -> Ints:
    """Return the trigger of each request, shape (R,), if a rule learns every latency after its cycle.

    A trigger is at most ``most``, below s; the robot stalls for max(0, d - m) ticks.
    """
    triggers = np.empty(latency_ns.size, np.int64)
    for request, latency in enumerate(latency_ns.tolist()):
        triggers[request] = trigger(rule.caution, setting, most).ticks
        rule.learn(latency, stalled=setting.delay(latency) > int(triggers[request]))
    return triggers


@dataclass(frozen=True, slots=True)
class VaryingTrigger(Mode):
    """Another acting mode, whose trigger is chosen anew for each request."""

    mode: Mode

    @property
    def name(self) -> str:
        return self.mode.name

    @property
    def streams(self) -> bool:  # type: ignore[override]
        return self.mode.streams

    @property
    def gap_ns(self) -> int:
        return self.mode.gap_ns

    @property
    def weight(self) -> float:
        return self.mode.weight


@dataclass(slots=True)
class TriggerStepper(ChunkStepper):
    """Sets a stepper's trigger before each `ask`."""

    stepper: ChunkStepper
    choose: Callable[[int], int]
    """Returns the trigger of a request, by its number."""
    request_tick: int = 0
    triggers: list[int] = field(default_factory=list)

    def arrived(self, request: int, actions: int, tick: int) -> None:
        self.stepper.arrived(request, actions, tick)
        self.past = self.stepper.past

    def ask(self, tick: int) -> bool:
        self.stepper.trigger = self.choose(len(self.triggers))
        asks = self.stepper.ask(tick)
        if asks:
            self.request_tick = tick
            self.triggers.append(self.stepper.trigger)
        return asks

    def act(self, tick: int) -> ChunkAction | None:
        return self.stepper.act(tick)


@dataclass(frozen=True, slots=True)
class Varied(VaryingTrigger):
    """Request chunk r when ``triggers[r]`` actions are left; the last trigger applies to all later requests."""

    triggers: tuple[int, ...]

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        last = len(self.triggers) - 1
        return TriggerStepper(self.mode.stepper(setting), lambda request: self.triggers[min(request, last)])


@dataclass(frozen=True, slots=True, eq=False)
class Learning(VaryingTrigger):
    """Choose each trigger by a rule, which ``begin`` makes: `follow` on a live robot.

    The robot measures whole ticks. The rule learns the middle of the latencies that give a delay of d ticks, which is
    unbiased for a mean, and makes no difference to a quantile or a maximum.
    """

    begin: Callable[[], TriggerRule]

    def stepper(self, setting: ControlSetting) -> LearningStepper:
        rule, most = self.begin(), greatest_trigger(self.mode, setting)
        stepper, length = self.mode.stepper(setting), self.mode.execution_horizon(setting)

        def choose(_request: int) -> int:
            return trigger(rule.caution, setting, most).ticks

        return LearningStepper(stepper, choose, rule=rule, setting=setting, length=length)


@dataclass(slots=True, kw_only=True)
class LearningStepper(TriggerStepper):
    """A stepper whose rule learns from the delay of every answer."""

    rule: TriggerRule
    setting: ControlSetting
    length: int
    """Executed actions of a chunk: the delay is known when the last of them has arrived."""
    learnt: int = 0
    """Requests with a known delay."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        TriggerStepper.arrived(self, request, actions, tick)  # `super()` does not know a class made anew for its slots
        if self.learnt <= request == len(self.triggers) - 1 and actions >= self.length:
            self.learnt = request + 1
            delay = tick - self.request_tick
            stalled = request > 0 and delay > self.triggers[-1]
            half_ticks = 2 * delay + (1 if self.setting.rounding == "floor" else -1)
            self.rule.learn(max(half_ticks, 0) * self.setting.period_ns // 2, stalled=stalled)
