"""Queue with a rule that chooses its trigger anew for every request, from the delays that it has seen itself.

What `trigger.follow` says of recorded latencies, a robot does here as it goes. It sees whole ticks, and learns the
middle of what a delay of d ticks can have been: no matter to a quantile or a maximum, and right for a mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from s2a_bench.policy.chunks import Mode
from s2a_bench.policy.chunks.append import QueueStepper, length_of
from s2a_bench.policy.chunks.trigger import trigger

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import Setting
    from s2a_bench.policy.chunks.trigger import Rule


@dataclass(frozen=True, slots=True, eq=False)
class Learning(Mode):
    """Ask when as few actions are left as a rule says, and append; ``begin`` makes the rule, ``execute`` is s."""

    name: ClassVar[str] = "queue"

    begin: Callable[[], Rule]
    execute: int = 0

    def stepper(self, setting: Setting) -> LearningStepper:
        """Follow one robot, with a rule of its own."""
        return LearningStepper(0, length_of(self.execute, setting), rule=self.begin(), setting=setting)


@dataclass(slots=True, kw_only=True)
class LearningStepper(QueueStepper):
    """A queue whose rule learns the delay of every answer."""

    rule: Rule
    setting: Setting
    asked_at: int = 0
    triggers: list[int] = field(default_factory=list)
    """That of each request so far."""

    def ask(self, tick: int) -> bool:
        """Ask when as few actions are left as the rule says."""
        self.trigger = trigger(self.rule.latency_ns, self.setting, max(1, self.length - 1)).ticks
        asks = QueueStepper.ask(self, tick)
        if asks:
            self.asked_at = tick
            self.triggers.append(self.trigger)
        return asks

    def arrived(self, request: int, actions: int, tick: int) -> None:
        """Queue what is new, and learn how long it took."""
        before = self.missing
        QueueStepper.arrived(self, request, actions, tick)
        if before and not self.missing:
            delay = tick - self.asked_at
            stalled = request > 0 and delay > self.triggers[-1]
            half_ticks = 2 * delay + (1 if self.setting.rounding == "floor" else -1)
            self.rule.learn(max(half_ticks, 0) * self.setting.period_ns // 2, stalled=stalled)
