"""Two policies that start when a share of the plan has arrived: a parameter, or what a calibration says."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.policy import CAUTION, PlanShape, Policy, Stepper
from s2a_bench.policy.estimator import VAGUE, GapPrior
from s2a_bench.policy.nominal import NominalQueue


@dataclass(frozen=True, slots=True)
class ToyPolicy(Policy):
    """Wait for N / ``factor`` skills, then run them back to back: factor 1 waits for all of them."""

    name: ClassVar[str] = "toy-policy"
    factor: float = 2.0

    def __post_init__(self) -> None:
        """Refuse a factor below 1."""
        if not self.factor >= 1:
            raise UsageError(f"`policy`: toy-policy?factor={self.factor:g} should be 1 or more")

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""
        return NominalQueue(math.ceil(shape.n_skills / self.factor))


@dataclass(frozen=True, slots=True)
class ToyCareful(Policy):
    """The same, but waits for lambda / (1 + lambda) of the skills: the greater its caution, the fewer stalls."""

    name: ClassVar[str] = "toy-careful"
    learns: ClassVar[bool] = True

    prior: GapPrior = VAGUE
    caution: float | None = None

    def informed(self, prior: GapPrior | None = None, caution: float | None = None) -> Policy:
        """Return it with what a calibration found."""
        return replace(self, prior=prior or self.prior, caution=self.caution if caution is None else caution)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""
        caution = CAUTION if self.caution is None else self.caution
        share = 1.0 if math.isinf(caution) else caution / (1 + caution)
        return NominalQueue(max(1, math.ceil(share * shape.n_skills)))
