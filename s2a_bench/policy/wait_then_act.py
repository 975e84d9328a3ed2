"""wait-then-act: start when the whole plan has arrived."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from s2a_bench.policy import Plans, PlanShape, Schedule, Start, Timing
from s2a_bench.policy.naive import Queue
from s2a_bench.policy.schedule import work_conserving

if TYPE_CHECKING:
    from s2a_bench.policy import Stepper


@dataclass(frozen=True, slots=True)
class WaitThenAct:
    """s_1 = t_N, then back to back at nominal durations: it never stalls, and starts last."""

    name: ClassVar[str] = "wait-then-act"

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once."""
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[-1]), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""
        return WaitingStepper(shape.n_skills)


@dataclass(slots=True)
class WaitingStepper:
    """Count the skills; the plan is whole when all have arrived, or when the stream ends before."""

    missing: int
    queue: Queue = field(default_factory=Queue)

    def token(self, at_s: float) -> None:
        """Ignore it."""

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Queue the skill."""
        self.missing -= 1
        self.queue.fragment(at_s, timing)

    def end(self, at_s: float) -> None:  # noqa: ARG002 - whenever it comes, the plan is whole
        """Stop waiting for more."""
        self.missing = 0

    def decide(self, now_s: float) -> Start | float:
        """Start the next skill once the plan is whole."""
        return math.inf if self.missing > 0 else self.queue.decide(now_s)
