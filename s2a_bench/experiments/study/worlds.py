"""Where studies draw their plans from: a rate, a granularity, a plan length, skills, and a family of gaps."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.boards.gaps import Gaps, Lognormal
from s2a_bench.policy import Plans, PlanShape, Timing
from s2a_bench.policy.arrivals import fragments
from s2a_bench.policy.conformal import calibrate
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import StreamToAct

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from s2a_bench.experiments.study.config import StudyConfig
    from s2a_bench.policy import Floats

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


def with_skills(token_s: Floats, shape: PlanShape, rng: np.random.Generator) -> Plans:
    """Make plans of tokens, shape (N L, M), by drawing each skill's duration: uniform around the expected one."""
    half = shape.expected_cv * 3**0.5
    factor = rng.uniform(1 - half, 1 + half, (shape.n_skills, token_s.shape[1]))
    return Plans(
        arrival_s=fragments(token_s, int(shape.tokens_per_skill)),
        nominal_s=factor * shape.expected.nominal_s,
        least_s=factor * shape.expected.least_s,
        most_s=factor * shape.expected.most_s,
        token_s=token_s,
        shape=shape,
    )


def recorded_plans(recordings: Sequence[ArrayLike], shape: PlanShape, rng: np.random.Generator) -> Plans:
    """Make one plan of each recorded answer: when its tokens arrived, in s from the request.

    Takes the first N L tokens and leaves shorter recordings out. Parts of one answer share its rate and would not be
    exchangeable with further answers, so that a long one makes one plan too.
    """
    count = shape.n_skills * int(shape.tokens_per_skill)
    long_enough = [np.asarray(token_s, dtype=np.float64)[:count] for token_s in recordings if np.size(token_s) >= count]
    return with_skills(np.stack(long_enough, axis=1) if long_enough else np.empty((count, 0)), shape, rng)


def calibrated(config: StudyConfig, world: World, plans: int) -> tuple[StreamToAct, Plans]:
    """Return stream-to-act with prior and lambda from calibration plans of a world, and other plans, as many as asked.

    ``plans`` is the study's own number, where none was asked for.
    """
    rng = generator(config.seed, config.name, world)
    calibration = world.draw(rng, config.calibration_plans)
    assert calibration.token_s is not None  # noqa: S101 - worlds draw tokens
    policy = StreamToAct(GapPrior.fit(calibration.token_s))
    policy = replace(policy, caution=calibrate(policy, calibration, config.epsilon, config.guarantee).caution)
    return policy, world.draw(rng, config.plans or plans)


def generator(seed: int, *key: object) -> np.random.Generator:
    """Return the random generator of one cell, the same whatever else is run, in whatever order."""
    return np.random.default_rng([seed, zlib.crc32(repr(key).encode())])


def _lognormal(rng: np.random.Generator, cv: float, plans: int) -> Floats:
    """Draw factors of mean 1."""
    variance = np.log1p(cv**2)
    return rng.lognormal(-variance / 2, np.sqrt(variance), plans)
