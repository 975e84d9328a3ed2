"""Policies as they would be prepared for a board: what they know of its tokens before the first one comes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from s2a_bench.errors import UsageError
from s2a_bench.experiments.study.worlds import generator, recorded_plans, with_skills
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.plans import Board
from s2a_bench.experiments.timeline.to_rows import Setting
from s2a_bench.policy import Policy
from s2a_bench.policy.conformal import Calibration, Guarantee, Tracker, choose, scores
from s2a_bench.policy.estimator import LEAST_CV, GapPrior
from s2a_bench.policy.parameters import canonical
from s2a_bench.policy.robust import RobustStart
from s2a_bench.policy.stream_to_act import CAUTION, StreamToAct
from s2a_bench.policy.tracking import Tracked

if TYPE_CHECKING:
    from s2a_bench.policy import Floats, Plans


@dataclass(slots=True)
class Knowledge:
    """What is learned of one setting before its plans."""

    prior: GapPrior
    plans: Plans | None
    """What lambda is calibrated on; None where nothing is random."""
    gap_bound_s: float | None
    """What s2a-robust is told."""
    epsilon: float
    guarantee: Guarantee
    calibrations: dict[StreamToAct, Calibration] = field(default_factory=dict)
    """Of the online rules as they were chosen, each for itself."""
    scores: dict[StreamToAct, Floats] = field(default_factory=dict)

    def prepare(self, policy: Policy) -> Policy:
        """Tell a policy what it was not told yet: online rules the prior and lambda, s2a-robust its bound."""
        if isinstance(policy, StreamToAct):
            caution = self._caution(policy) if policy.caution is None else policy.caution
            return replace(policy, prior=self.prior, caution=caution)
        if isinstance(policy, RobustStart) and self.gap_bound_s is not None and math.isinf(policy.gap_bound_s):
            return replace(policy, gap_bound_s=self.gap_bound_s)
        return policy

    def tracked(self, policy: Policy) -> Tracked | None:
        """Return what follows the lambda of a policy from plan to plan; None where it has none, or was told it."""
        if not isinstance(policy, StreamToAct) or policy.caution is not None or self.plans is None:
            return None
        self._caution(policy)
        return Tracked(replace(policy, prior=self.prior), Tracker(self.scores[policy], self.epsilon))

    def _caution(self, policy: StreamToAct) -> float:
        if self.plans is None:
            return CAUTION
        if policy not in self.calibrations:
            self.scores[policy] = scores(replace(policy, prior=self.prior), self.plans)
            self.calibrations[policy] = choose(self.scores[policy], self.epsilon, self.guarantee)
        return self.calibrations[policy].caution

    def facts(self, setting: Setting) -> dict[str, Any]:
        """Return the calibrations as plain data, stream-to-act's by the setting's name, others by their cell's."""
        return {
            setting.name if rule == StreamToAct() else f"{setting.name}/{canonical(rule.name, rule)}": asdict(found)
            | {"caution": finite(found.caution)}
            for rule, found in self.calibrations.items()
        }


def finite(caution: float | None) -> float | None:
    """Return lambda, or None where it is infinite: JSON has no infinity."""
    return None if caution is None or caution == float("inf") else caution


def learn(config: TimelineConfig, board: Board, setting: Setting, answers: Sequence[Floats] = ()) -> Knowledge:
    """Learn a prior, and what to calibrate on, from other plans of the same kind: drawn ones, or recorded ``answers``.

    Where nothing is random the prior is as certain as the arrivals, and the online rule starts at S0.
    """
    bound_s = config.gap_bound and config.gap_bound * setting.tokens_per_skill / setting.tokens_per_s
    plans = None
    if answers:
        plans = plans_of(config, setting, answers)
        prior = GapPrior.fit(plans.token_s)  # type: ignore[arg-type]  # recorded plans have tokens
    elif config.random and any(isinstance(policy, StreamToAct) for policy in config.chosen.values()):
        count = max(setting.n_skills * setting.tokens_per_skill, 3)  # a spread needs two gaps
        rng = generator(config.seed, "timeline", "prior", setting)
        prior = GapPrior.fit(board.tokens(count, rng, config.calibration_plans))
        _, plans = draw(config, board, setting, config.calibration_plans, "calibration")
    else:
        prior = GapPrior(1 / board.tokens_per_s, LEAST_CV, LEAST_CV)
    return Knowledge(prior, plans, bound_s, config.epsilon, config.guarantee)


def plans_of(config: TimelineConfig, setting: Setting, answers: Sequence[Floats]) -> Plans:
    """Make plans of recorded answers; raises UsageError where too few are long enough."""
    rng = generator(config.seed, "timeline", "calibration", setting)
    plans = recorded_plans(answers, config.shape(setting), rng)
    count, tokens = plans.arrival_s.shape[1], setting.n_skills * setting.tokens_per_skill
    if (count + 1) * config.epsilon < 1:
        raise UsageError(
            f"`calibrate`: {count} of {len(answers)} answers have the {tokens} tokens of {setting.name}; "
            f"`epsilon` {config.epsilon:g} needs {math.ceil(1 / config.epsilon) - 1}"
        )
    return plans


def draw(config: TimelineConfig, board: Board, setting: Setting, plans: int, purpose: str) -> tuple[Floats, Plans]:
    """Draw plans and the tokens that they come in; each purpose has random numbers of its own."""
    rng = generator(config.seed, "timeline", purpose, setting)
    shape = config.shape(setting)
    token_s = board.tokens(setting.n_skills * setting.tokens_per_skill, rng, plans)
    return token_s, with_skills(token_s, shape, rng)
