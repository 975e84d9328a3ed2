"""Learning of policies: from a board's tokens before the first plan, and from plan to plan in executed runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from s2a_bench.act.record import Record, observed
from s2a_bench.boards.tokens import Board
from s2a_bench.errors import UsageError
from s2a_bench.harness.timelines.cases import MOST_CV, LearningPlan, PlanCase, PlanSetting
from s2a_bench.policy import CAUTION, ONLINE, TOLERANCE_S, Floats, Plans, PlanShape, Policy
from s2a_bench.policy.arrivals import recorded_plans, with_skills
from s2a_bench.policy.conformal import PLANS, Calibration, TrackedPolicy, Tracker, choose, scores
from s2a_bench.policy.estimator import LEAST_CV, PLAN_CV, GapPrior
from s2a_bench.stats.seeds import generator


@dataclass(slots=True)
class Following:
    """The policies of one case by name, prepared for its plans."""

    shape: PlanShape
    by_name: dict[str, Policy]
    tracked: dict[str, TrackedPolicy] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)

    @property
    def unset(self) -> dict[str, Policy]:
        """Return the policies whose lambda is not set."""
        return {name: policy for name, policy in self.by_name.items() if policy.learns and policy.caution is None}

    def policies(self) -> dict[str, Policy]:
        return {**self.by_name, **{name: each.policy for name, each in self.tracked.items()}}

    def learn(self, records: Sequence[Record]) -> None:
        """Learn from the records of an executed plan; an incomplete one is ignored."""
        for record in records:
            plan = observed(record, self.shape)
            if plan is not None and record.policy in self.tracked:
                stalled = any(stall_ns > TOLERANCE_S * 1e9 for stall_ns in record.stalls_ns)
                self.tracked[record.policy].learn(plan, stalled=stalled)

    def facts(self, setting: PlanSetting) -> dict[str, Any]:
        """Return the calibrations as plain data, stream-to-act's by the setting's name, others by the cell's."""
        return {
            setting.name if name == ONLINE else f"{setting.name}/{name}": asdict(calibration)
            | {"caution": finite(calibration.caution)}
            for name, calibration in self.calibrations.items()
        }


def finite(caution: float | None) -> float | None:
    """Return lambda, or None if it is infinite: JSON has no infinity."""
    return None if caution is None or caution == float("inf") else caution


def learn(case: PlanCase, plan: LearningPlan) -> Following:
    """Give policies a prior, and calibrate lambda, from drawn plans of the same kind or recorded answers."""
    if plan.answers:
        plans = plans_of(case, plan)
        prior = GapPrior.fit(plans.token_s)  # type: ignore[arg-type]  # recorded plans have tokens
    elif plan.random and any(policy.learns for policy in plan.policies.values()):
        count = max(case.tokens, 3)  # a spread needs two gaps
        rng = generator(plan.seed, "timeline", "prior", case.setting.key)
        prior = GapPrior.fit(case.board.tokens(count, rng, plan.calibration_plans))
        _, plans = draw(case, plan.seed, plan.calibration_plans, "calibration")
    else:
        return Following(case.shape, certain(plan.policies, case.board))
    following = Following(case.shape, {name: policy.informed(prior) for name, policy in plan.policies.items()})
    for name, policy in following.unset.items():
        score = scores(policy, plans)
        calibration = choose(score, plan.epsilon, plan.guarantee, plans.arrival_s[-1])
        following.calibrations[name] = calibration
        following.by_name[name] = policy.informed(caution=calibration.caution)
        if plan.track:
            following.tracked[name] = TrackedPolicy(policy, Tracker(score, plan.epsilon))
    return following


def certain(policies: Mapping[str, Policy], board: Board) -> dict[str, Policy]:
    """Give policies a prior as certain as even arrivals are: the online rule starts at S0."""
    prior = GapPrior(1 / board.tokens_per_s, LEAST_CV, LEAST_CV)
    return {
        name: policy.informed(prior, CAUTION if policy.caution is None else None) for name, policy in policies.items()
    }


def prepare(plan: LearningPlan, shape: PlanShape, prior: GapPrior | None) -> Following:
    """Give policies the prior of a model's answers, and a lambda that is tracked, not calibrated."""
    following = Following(shape, {name: policy.informed(prior) for name, policy in plan.policies.items()})
    for name, policy in following.unset.items():
        if plan.track:
            plans = draw_plans(policy.prior, shape, generator(plan.seed, "tracking", shape.key), PLANS)
            following.tracked[name] = TrackedPolicy.begin(policy, plans, plan.epsilon)
        else:
            following.by_name[name] = policy.informed(caution=CAUTION)
    return following


def plans_of(case: PlanCase, plan: LearningPlan) -> Plans:
    """Make plans of recorded answers; raises UsageError if too few are long enough."""
    rng = generator(plan.seed, "timeline", "calibration", case.setting.key)
    plans = recorded_plans(plan.answers, case.shape, rng)
    count = plans.arrival_s.shape[1]
    if (count + 1) * plan.epsilon < 1:
        raise UsageError(
            f"`calibrate`: {count} of {len(plan.answers)} answers have the {case.tokens} tokens of "
            f"{case.setting.name}; `epsilon` {plan.epsilon:g} needs {math.ceil(1 / plan.epsilon) - 1}"
        )
    return plans


def draw(case: PlanCase, seed: int, plans: int, purpose: str) -> tuple[Floats, Plans]:
    """Draw the arrivals of tokens, and the plans in them; each purpose has separate random numbers."""
    rng = generator(seed, "timeline", purpose, case.setting.key)
    token_s = case.board.tokens(case.tokens, rng, plans)
    return token_s, with_skills(token_s, case.shape, rng)


def draw_plans(prior: GapPrior, shape: PlanShape, rng: np.random.Generator, plans: int) -> Plans:
    """Draw plans of a prior: lognormal rates and gaps, uniform durations."""

    def lognormal(cv: float, *size: int) -> Any:
        variance = np.log1p(cv**2)
        return rng.lognormal(-variance / 2, np.sqrt(variance), size)

    gaps_s = (
        prior.mean_s
        * lognormal(prior.plan_cv, plans)
        * lognormal(prior.token_cv, shape.n_skills * int(shape.tokens_per_skill), plans)
    )
    even = replace(shape, expected_cv=min(shape.expected_cv, MOST_CV))
    return replace(with_skills(np.cumsum(gaps_s, axis=0), even, rng), shape=shape)


def prior_of(arrivals_ns: Sequence[Sequence[int]], rate: float | None) -> GapPrior | None:
    """Learn the gaps from warm-ups, else their mean from a set rate; None without both."""
    gaps_s = np.array([float(gap) for times in arrivals_ns for gap in np.diff(times)]) / 1e9
    if gaps_s.size > 1 and gaps_s.mean() > 0:
        mean_s = float(gaps_s.mean())
        return GapPrior(mean_s, PLAN_CV, max(_spread_s(gaps_s) / mean_s, LEAST_CV))
    return None if rate is None else GapPrior(1 / rate, PLAN_CV, 2 * PLAN_CV)


def _spread_s(gaps_s: Floats) -> float:
    """Return sigma of a gap, of single gaps or of sums over blocks, if that is larger, as with bursts."""
    size = max(1, round(gaps_s.size**0.5))
    blocks = gaps_s[: gaps_s.size // size * size].reshape(-1, size).sum(axis=1)
    of_blocks = float(blocks.std(ddof=1)) / size**0.5 if blocks.size > 1 else 0.0
    return max(float(gaps_s.std(ddof=1)), of_blocks)
