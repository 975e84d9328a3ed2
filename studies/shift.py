"""What happens when plans come otherwise than those that lambda was calibrated on, and what helps.

The machine is calibrated as it is without shift. Then its gaps are longer, heavier in the tail, or bursty; or its rate
changes within each plan. Four ways to go on: *fixed* keeps prior and lambda; *tracked* follows lambda from plan to plan
(`tracking.TrackedPolicy`); *detected* keeps lambda and detects changes of the rate within a plan (`changes`); *both*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from s2a_bench.boards.gaps import Gaps, Lognormal, Markov
from s2a_bench.policy import Plans
from s2a_bench.policy.conformal import ANY_STALL_S, TrackedPolicy, Tracker, choose, scores
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import measure
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.stats.seeds import generator
from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, row_of
from studies.worlds import TOKEN_CV, World

if TYPE_CHECKING:
    from s2a_bench.policy import Floats

PLANS: Final = 400
ARMS: Final = ("fixed", "tracked", "detected", "both")
WORLDS: Final = (
    World(4.8, 0.5, 6, 8, 1.0),
    World(4.8, 0.5, 4, 16, 1.0),
    World(0.58, 3.0, 1, 16, 2.0),
    World(0.58, 3.0, 4, 8, 2.0),
    World(0.58, 3.0, 6, 8, 1.0),
)
"""rho .83, .83, .86, 1.25, 3.4 and 10.3: where stalls threaten."""
WALK_CV: Final = 0.3
"""How far a random walk of the rate has come by the end of a plan."""

Shift: TypeAlias = Callable[[World, np.random.Generator, int], Plans]


@dataclass(frozen=True, slots=True)
class Gamma:
    """Independent gamma gaps; ``cv`` is standard deviation / mean."""

    mean_s: float
    cv: float

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        """Draw gaps."""
        return rng.gamma(self.cv**-2, self.mean_s * self.cv**2, (tokens, plans))


@dataclass(frozen=True, slots=True)
class Pareto:
    """Independent gaps, never shorter than mean (1 - 1 / tail) and with P(gap > x) falling as x^-tail."""

    mean_s: float
    tail: float

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        """Draw gaps."""
        gaps: Floats = (rng.pareto(self.tail, (tokens, plans)) + 1) * (self.mean_s * (1 - 1 / self.tail))
        return gaps


def _slower(world: World, rng: np.random.Generator, plans: int, *, times: float) -> Plans:
    return world.draw(rng, plans, times)


def _other_gaps(world: World, rng: np.random.Generator, plans: int, *, gaps: Callable[[float], Gaps]) -> Plans:
    return replace(world, gaps=gaps(1 / world.tokens_per_s)).draw(rng, plans)


def _walk(world: World, rng: np.random.Generator, plans: int) -> Plans:
    """Let the logarithm of the rate wander from token to token."""
    tokens = world.n_skills * world.tokens_per_skill
    steps = rng.normal(0.0, WALK_CV / tokens**0.5, (tokens, plans))
    return world.draw(rng, plans, np.exp(np.cumsum(steps, axis=0)))


def _halves(world: World, rng: np.random.Generator, plans: int) -> Plans:
    """Let the rate halve in the middle of every plan."""
    tokens = world.n_skills * world.tokens_per_skill
    return world.draw(rng, plans, np.where(np.arange(tokens) < tokens // 2, 1.0, 2.0)[:, np.newaxis])


SHIFTS: Final[dict[str, Shift]] = {
    "none": partial(_slower, times=1.0),
    "gaps x 1.3": partial(_slower, times=1.3),
    "gaps x 1.5": partial(_slower, times=1.5),
    "lognormal, CV 50 %": partial(_other_gaps, gaps=partial(Lognormal, cv=0.5)),
    "gamma, CV 70 %": partial(_other_gaps, gaps=partial(Gamma, cv=0.7)),
    "Pareto, tail 2.5": partial(_other_gaps, gaps=partial(Pareto, tail=2.5)),
    "2 % of the tokens in pauses": partial(
        _other_gaps, gaps=partial(Markov, cv=TOKEN_CV, pause_share=0.02, pause_ratio=10.0, pause_tokens=3.0)
    ),
    "rate walks by 30 % within a plan": _walk,
    "rate halves in mid-plan": _halves,
}


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List worlds and shifts."""
    return [partial(cell, config, world, name) for world in WORLDS for name in SHIFTS]


def cell(config: StudyConfig, world: World, shift: str) -> list[StudyRow]:
    """Decide the same plans in each of the ways."""
    rng = generator(config.seed, config.name, world.key, shift)
    calibration = world.draw(rng, config.calibration_plans)
    plans = SHIFTS[shift](world, rng, config.plans or PLANS)
    assert calibration.token_s is not None  # noqa: S101 - worlds draw tokens
    rows = []
    for detect in (False, True):
        policy = StreamToAct(GapPrior.fit(calibration.token_s), detect=detect)
        score = scores(policy, calibration)
        fixed = replace(policy, caution=choose(score, config.epsilon, config.guarantee).caution)
        caution, schedule = TrackedPolicy(policy, Tracker(score, config.epsilon)).follow(plans)
        ways = {
            "detected" if detect else "fixed": (fixed.caution, fixed.schedule(plans)),
            "both" if detect else "tracked": (float(np.median(caution)), schedule),
        }
        rows += [
            row_of(
                config.name,
                world,
                policy.name,
                measure(plans, decided, tolerance_s=ANY_STALL_S),
                caution=each,
                calibration_plans=config.calibration_plans,
                condition=f"{shift}, {arm}",
            )
            for arm, (each, decided) in ways.items()
        ]
    return rows
