"""wait-then-act and s2a-clairvoyant: wait until the whole plan has arrived, or until S0; then act as naive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, PlanShape, Policy, Schedule, Start, Stepper, Timing
from s2a_bench.policy.naive import NominalQueue
from s2a_bench.policy.schedule import safe_start, work_conserving


@dataclass(frozen=True, slots=True)
class WaitThenAct(Policy):
    """s_1 = t_N, then back to back at nominal durations: no stalls, and the latest start."""

    name: ClassVar[str] = "wait-then-act"
    colour: ClassVar[str] = "#0072B2"
    stalls: ClassVar[bool] = False

    def schedule(self, plans: Plans) -> Schedule:
        return Schedule(work_conserving(plans.arrival_s, plans.nominal_s, plans.arrival_s[-1]), plans.nominal_s)

    def stepper(self, shape: PlanShape) -> Stepper:
        return WaitingStepper(shape.n_skills)


class WaitingStepper(NominalQueue):
    """Wait for ``missing`` skills, or for the end of the stream."""

    def __init__(self, missing: int) -> None:
        super().__init__()
        self.missing = missing

    def fragment(self, at_s: float, timing: Timing) -> None:
        self.missing -= 1
        super().fragment(at_s, timing)

    def end(self, at_s: float) -> None:  # noqa: ARG002 - the time does not matter
        self.missing = 0

    def decide(self, now_s: float) -> Start | float:
        return math.inf if self.missing > 0 else super().decide(now_s)


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
        return ClairvoyantStepper(shape.safe_start_s)


class ClairvoyantStepper(NominalQueue):
    def __init__(self, start_s: float) -> None:
        super().__init__()
        self.start_s = start_s

    def decide(self, now_s: float) -> Start | float:
        return self.start_s if now_s < self.start_s else super().decide(now_s)
