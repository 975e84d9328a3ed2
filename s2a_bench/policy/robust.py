"""s2a-robust: start when no stall can follow, if gaps between arrivals never exceed a declared bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Schedule, Start, Timing
from s2a_bench.policy.naive import Queue

if TYPE_CHECKING:
    from s2a_bench.policy import Stepper


@dataclass(frozen=True, slots=True)
class RobustStart:
    """Start at the first s >= max(t_i - P_{i-1} of what has come, t_m + (i - m) gap_bound - P_{i-1} of what has not).

    With gaps up to ``gap_bound_s`` between fragments it is the earliest rule that never stalls at nominal durations
    (T6), given those durations; a skill that has not been parsed counts with ``expected.least_s``, the least it may
    take. Without a bound every such rule waits for the whole plan, and so does this one.
    """

    gap_bound_s: float = math.inf

    def __post_init__(self) -> None:
        """Refuse what is no bound."""
        if not self.gap_bound_s > 0:
            raise UsageError(f"gap bound: {self.gap_bound_s:g} s should be above 0")

    @property
    def name(self) -> str:
        """Return its name."""
        return "s2a-robust"

    def wait_s(self, shape: PlanShape, parsed: int) -> float:
        """Return how much the missing skills demand: max (i - m) gap_bound - (durations of m + 1 ... i - 1).

        It grows or falls evenly from skill to skill, so that the next one or the last one decides.
        """
        missing = shape.n_skills - parsed
        if missing <= 0:
            return -math.inf
        beyond_s = self.gap_bound_s - shape.expected.least_s
        return self.gap_bound_s + ((missing - 1) * beyond_s if missing > 1 and beyond_s > 0 else 0.0)

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once; they need ``shape``, raises ValueError without."""
        import numpy as np

        from s2a_bench.policy.schedule import align, work_conserving

        if plans.shape is None:
            raise ValueError("s2a-robust needs to know how many skills to expect: plans need shape")
        arrival_s, nominal_s = align(plans.arrival_s, plans.nominal_s)
        # When all has come there is nothing to wait for.
        end_s = arrival_s[-1] if plans.token_s is None else np.maximum(arrival_s[-1], plans.token_s[-1])
        start_s = end_s
        known_s = nominal_s.sum(axis=0)
        until_s = end_s
        for m in reversed(range(len(arrival_s))):
            safe_s = np.maximum(arrival_s[m], arrival_s[m] + self.wait_s(plans.shape, m + 1) - known_s)
            # What follows from m + 1 fragments holds until the next comes.
            start_s = np.where(safe_s < until_s, safe_s, start_s)
            known_s = known_s - nominal_s[m]
            until_s = arrival_s[m]
        return Schedule(work_conserving(arrival_s, nominal_s, start_s), nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""
        return RobustStepper(self, shape)


@dataclass(slots=True)
class RobustStepper:
    """Wait for the safe start, then start whatever has arrived."""

    rule: RobustStart
    shape: PlanShape
    parsed: int = 0
    known_s: float = 0.0
    start_s: float = math.inf
    """As things stand; once it has come it is in the past."""
    queue: Queue = field(default_factory=Queue)

    def token(self, at_s: float) -> None:
        """Ignore it."""

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Queue the skill; until it came, the start time was what the skills before it demanded."""
        self.queue.fragment(at_s, timing)
        self.parsed += 1
        self.known_s += timing.nominal_s
        if self.start_s >= at_s:
            self.start_s = at_s + max(0.0, self.rule.wait_s(self.shape, self.parsed) - self.known_s)

    def end(self, at_s: float) -> None:
        """Stop waiting."""
        self.start_s = min(self.start_s, at_s)

    def decide(self, now_s: float) -> Start | float:
        """Start the next skill once the start time has come."""
        return self.start_s if now_s < self.start_s else self.queue.decide(now_s)
