"""Policies as they would be prepared for a board: what they know of its tokens before the first one comes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.experiments.study.worlds import generator, recorded_plans, with_skills
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.plans import Board
from s2a_bench.experiments.timeline.to_rows import Setting
from s2a_bench.policy import Policy
from s2a_bench.policy.conformal import Calibration, calibrate
from s2a_bench.policy.estimator import LEAST_CV, GapPrior
from s2a_bench.policy.robust import RobustStart
from s2a_bench.policy.stream_to_act import CAUTION, StreamToAct

if TYPE_CHECKING:
    from s2a_bench.policy import Floats, Plans


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What is learned of one setting before its plans."""

    online: StreamToAct
    """stream-to-act with its prior and lambda."""
    calibration: Calibration | None
    """None where nothing is random."""
    gap_bound_s: float | None
    """What s2a-robust is told."""

    def prepare(self, policy: Policy) -> Policy:
        """Tell a policy what it was not told yet: online rules the prior and lambda, s2a-robust its bound."""
        if isinstance(policy, StreamToAct):
            caution = self.online.caution if policy.caution is None else policy.caution
            return replace(policy, prior=self.online.prior, caution=caution)
        if isinstance(policy, RobustStart) and self.gap_bound_s is not None and math.isinf(policy.gap_bound_s):
            return replace(policy, gap_bound_s=self.gap_bound_s)
        return policy


def learn(config: TimelineConfig, board: Board, setting: Setting, answers: Sequence[Floats] = ()) -> Knowledge:
    """Learn prior and lambda from other plans of the same kind: drawn ones, or recorded ``answers`` if there are any.

    Where nothing is random the prior is as certain as the arrivals, and the online rule starts at S0.
    """
    bound_s = config.gap_bound and config.gap_bound * setting.tokens_per_skill / setting.tokens_per_s
    if answers:
        plans = plans_of(config, setting, answers)
        prior = GapPrior.fit(plans.token_s)  # type: ignore[arg-type]  # recorded plans have tokens
    elif config.random and any(isinstance(policy, StreamToAct) for policy in config.chosen.values()):
        count = max(setting.n_skills * setting.tokens_per_skill, 3)  # a spread needs two gaps
        rng = generator(config.seed, "timeline", "prior", setting)
        prior = GapPrior.fit(board.tokens(count, rng, config.calibration_plans))
        _, plans = draw(config, board, setting, config.calibration_plans, "calibration")
    else:
        return Knowledge(StreamToAct(GapPrior(1 / board.tokens_per_s, LEAST_CV, LEAST_CV), CAUTION), None, bound_s)
    policy = StreamToAct(prior)
    calibration = calibrate(policy, plans, config.epsilon, config.guarantee)
    return Knowledge(replace(policy, caution=calibration.caution), calibration, bound_s)


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
