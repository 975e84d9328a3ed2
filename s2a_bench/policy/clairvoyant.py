"""s2a-clairvoyant: stream-to-act as the paper defines it, starting at S0, which needs to know every arrival."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Schedule, Start, Timing
from s2a_bench.policy.naive import Queue
from s2a_bench.policy.schedule import safe_start, work_conserving

if TYPE_CHECKING:
    from s2a_bench.policy import Stepper


@dataclass(frozen=True, slots=True)
class Clairvoyant:
    """s_1 = S0 = max_i (t_i - P_{i-1}), then back to back at nominal durations: no stalls, and naive's end."""

    name: ClassVar[str] = "s2a-clairvoyant"

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once."""
        first_s = safe_start(plans.arrival_s, plans.nominal_s)
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, first_s), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives; raises UsageError where ``shape`` does not tell S0."""
        if shape.safe_start_s is None:
            raise UsageError(
                "`policy`: s2a-clairvoyant needs to know when every skill will arrive, so it runs on recorded or "
                "modelled arrivals only; stream-to-act is what a robot can run"
            )
        return ClairvoyantStepper(shape.safe_start_s)


@dataclass(slots=True)
class ClairvoyantStepper:
    """Wait for S0, then start whatever has arrived."""

    start_s: float
    queue: Queue = field(default_factory=Queue)

    def token(self, at_s: float) -> None:
        """Ignore it."""

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Queue the skill."""
        self.queue.fragment(at_s, timing)

    def end(self, at_s: float) -> None:
        """Ignore it."""

    def decide(self, now_s: float) -> Start | float:
        """Start the next skill once S0 has come."""
        return self.start_s if now_s < self.start_s else self.queue.decide(now_s)
