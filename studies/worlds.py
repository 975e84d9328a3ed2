"""Where studies draw their plans from: a rate, a granularity, a plan length, skills, and a family of gaps.

With the rules that are decided there and that the product does not offer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from s2a_bench.boards.gaps import Gaps, Lognormal
from s2a_bench.policy import CAUTION, Plans, PlanShape, Timing
from s2a_bench.policy.arrivals import with_skills
from s2a_bench.policy.conformal import calibrate
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import Caution, MeanStart, StreamToAct
from s2a_bench.stats.seeds import Verbatim, generator

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from studies.config import StudyConfig

LEAST, MOST = 0.8, 1.5
"""T_min and T_max over T_nom."""
HARD = 0.8
"""rho above which starting when a skill arrives is not safe."""
SKILL_CV = 0.20
PLAN_CV = 0.10
TTFT_CV = 0.15
TOKEN_CV = 0.20


@dataclass(frozen=True, slots=True)
class World:
    """One setting. Without ``gaps`` tokens come with independent lognormal gaps of CV 20 %."""

    tokens_per_s: float
    prompt_s: float
    """c: the time to first token is c + 1 / R in the mean."""
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    gaps: Gaps | None = None
    """Of mean 1 / R; scaled for each plan by its own rate."""

    @property
    def rho(self) -> float:
        """Return (L / R) / T_nom: above 1 skills take less time than their tokens."""
        return self.tokens_per_skill / self.tokens_per_s / self.t_nom_s

    @property
    def key(self) -> Verbatim:
        """Return what its draws follow from."""
        return Verbatim(
            f"World(tokens_per_s={self.tokens_per_s!r}, prompt_s={self.prompt_s!r}, "
            f"tokens_per_skill={self.tokens_per_skill!r}, n_skills={self.n_skills!r}, t_nom_s={self.t_nom_s!r}, "
            f"gaps={self.gaps!r})"
        )

    @property
    def shape(self) -> PlanShape:
        """Return what is known before the first token."""
        timing = Timing(self.t_nom_s, LEAST * self.t_nom_s, MOST * self.t_nom_s)
        return PlanShape(self.n_skills, self.tokens_per_skill, timing, SKILL_CV)

    def draw(self, rng: np.random.Generator, plans: int, slower: Floats | float = 1.0) -> Plans:
        """Draw plans; ``slower`` stretches all gaps, one factor or one a plan, as a machine that throttles does.

        Time to first token: lognormal, CV 15 %. Each plan's mean gap: lognormal, CV 10 %. T_nom of each skill: uniform,
        CV 20 %; T_min and T_max in proportion.
        """
        gap_s = 1 / self.tokens_per_s
        gaps = self.gaps or Lognormal(gap_s, TOKEN_CV)
        token_s = gaps.sample(rng, self.n_skills * self.tokens_per_skill, plans)
        token_s *= _lognormal(rng, PLAN_CV, plans) * slower
        token_s[0] = (self.prompt_s + gap_s) * _lognormal(rng, TTFT_CV, plans)
        np.cumsum(token_s, axis=0, out=token_s)
        return with_skills(token_s, self.shape, rng)


@dataclass(frozen=True, slots=True)
class QuantileStart(MeanStart):
    """Start when the cautious forecast meets the nominal durations, never stretch."""

    name: ClassVar[str] = "s2a-quantile"

    caution: Caution | None = CAUTION


def calibrated(config: StudyConfig, world: World, plans: int) -> tuple[StreamToAct, Plans]:
    """Return stream-to-act with prior and lambda from calibration plans of a world, and other plans.

    ``plans`` is the study's default number.
    """
    rng = generator(config.seed, config.name, world.key)
    calibration = world.draw(rng, config.calibration_plans)
    assert calibration.token_s is not None  # noqa: S101 - worlds draw tokens
    policy = StreamToAct(GapPrior.fit(calibration.token_s))
    policy = replace(policy, caution=calibrate(policy, calibration, config.epsilon, config.guarantee).caution)
    return policy, world.draw(rng, config.plans or plans)


def _lognormal(rng: np.random.Generator, cv: float, plans: int) -> Floats:
    """Draw factors of mean 1."""
    variance = np.log1p(cv**2)
    return rng.lognormal(-variance / 2, np.sqrt(variance), plans)
