"""naive, wait-then-act and s2a-clairvoyant: act at nominal durations from the first arrival, the last one, or S0 on."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Policy, Schedule, Start, Stepper, Timing
from s2a_bench.policy.schedule import safe_start, work_conserving


@dataclass(slots=True)
class NominalQueue:
    """Start skills in the order of their arrival at nominal durations: the rule of any policy once the robot moves.

    It begins when ``missing`` skills have arrived, or the stream has ended, and not before ``start_s``.
    """

    missing: int = 0
    start_s: float = -math.inf
    waiting: deque[Timing] = field(default_factory=deque)

    def token(self, at_s: float) -> None: ...

    def fragment(self, at_s: float, timing: Timing) -> None:  # noqa: ARG002 - it may start at once
        self.missing -= 1
        self.waiting.append(timing)

    def end(self, at_s: float) -> None:  # noqa: ARG002 - the time does not matter
        self.missing = 0

    def decide(self, now_s: float) -> Start | float:
        if self.missing > 0 or not self.waiting:
            return math.inf
        if now_s < self.start_s:
            return self.start_s
        nominal_s = self.waiting.popleft().nominal_s
        return Start(nominal_s, nominal_s)


@dataclass(frozen=True, slots=True)
class Naive(Policy):
    """s_1 = t_1 and s_i = max(t_i, e_{i-1}) at nominal durations (the paper's naive streaming, section IV-F)."""

    name: ClassVar[str] = "naive"
    colour: ClassVar[str] = "#E69F00"

    def schedule(self, plans: Plans) -> Schedule:
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[0]), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:  # noqa: ARG002 - only what has arrived matters
        return NominalQueue()


@dataclass(frozen=True, slots=True)
class WaitThenAct(Policy):
    """s_1 = t_N, then back to back at nominal durations: no stalls, and the latest start."""

    name: ClassVar[str] = "wait-then-act"
    colour: ClassVar[str] = "#0072B2"
    stalls: ClassVar[bool] = False

    def schedule(self, plans: Plans) -> Schedule:
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[-1]), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        return NominalQueue(shape.n_skills)


@dataclass(frozen=True, slots=True)
class Clairvoyant(Policy):
    """Stream-to-act as the paper defines it, with every arrival known: no stalls, and the end of naive.

    s_1 = S0 = max_i (t_i - P_{i-1}), then back to back at nominal durations.
    """

    name: ClassVar[str] = "s2a-clairvoyant"
    stalls: ClassVar[bool] = False

    def schedule(self, plans: Plans) -> Schedule:
        first_s = safe_start(plans.arrival_s, plans.nominal_s)
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, first_s), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Return a stepper for one plan; raises UsageError if ``shape.safe_start_s`` is None."""
        if shape.safe_start_s is None:
            raise UsageError(
                "`policy`: s2a-clairvoyant needs to know when every skill will arrive, so it runs on recorded or "
                "modelled arrivals only; stream-to-act is what a robot can run"
            )
        return NominalQueue(start_s=shape.safe_start_s)
