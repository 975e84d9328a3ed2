"""naive: start each skill as soon as it has arrived and the one before has ended."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

from s2a_bench.policy import Plans, PlanShape, Policy, Schedule, Start, Stepper, Timing
from s2a_bench.policy.schedule import work_conserving


@dataclass(frozen=True, slots=True)
class Naive(Policy):
    """s_1 = t_1 and s_i = max(t_i, e_{i-1}) at nominal durations (the paper's naive streaming, section IV-F)."""

    name: ClassVar[str] = "naive"
    colour: ClassVar[str] = "#E69F00"

    def schedule(self, plans: Plans) -> Schedule:
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[0]), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:  # noqa: ARG002 - only what has arrived matters
        return NominalQueue()


@dataclass(slots=True)
class NominalQueue:
    """Start skills in the order of their arrival at nominal durations: the rule of any policy once the robot moves."""

    waiting: deque[Timing] = field(default_factory=deque)

    def token(self, at_s: float) -> None: ...

    def fragment(self, at_s: float, timing: Timing) -> None:  # noqa: ARG002 - it may start at once
        self.waiting.append(timing)

    def end(self, at_s: float) -> None: ...

    def decide(self, now_s: float) -> Start | float:  # noqa: ARG002 - now, if there is something to start
        if not self.waiting:
            return math.inf
        nominal_s = self.waiting.popleft().nominal_s
        return Start(nominal_s, nominal_s)
