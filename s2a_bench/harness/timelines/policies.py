"""The knowledge of policies: of a board's tokens before the first one, and from plan to plan in executed runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from s2a_bench.act.record import Record, observed
from s2a_bench.errors import UsageError
from s2a_bench.harness.timelines.cases import MOST_CV, LearningPlan, PlanCase, PlanSetting
from s2a_bench.policy import CAUTION, ONLINE, TOLERANCE_S, Floats, Plans, PlanShape, Policy
from s2a_bench.policy.arrivals import recorded_plans, with_skills
from s2a_bench.policy.conformal import EPSILON, PLANS, Calibration, Guarantee, Tracker, choose, scores
from s2a_bench.policy.estimator import LEAST_CV, PLAN_CV, GapPrior
from s2a_bench.policy.parameters import canonical
from s2a_bench.policy.tracking import TrackedPolicy
from s2a_bench.stats.seeds import generator


@dataclass(slots=True)
class Knowledge:
    """Knowledge about one setting before its plans."""

    prior: GapPrior
    plans: Plans | None
    """The plans for calibrating lambda; None if nothing is random."""
    epsilon: float
    guarantee: Guarantee
    calibrations: dict[Policy, Calibration] = field(default_factory=dict)
    """Of each online policy."""
    scores: dict[Policy, Floats] = field(default_factory=dict)

    def prepare(self, policy: Policy) -> Policy:
        """Give a policy the prior, and lambda if it is not set."""
        return policy.informed(self.prior, self._caution(policy) if _open(policy) else None)

    def tracked(self, policy: Policy) -> TrackedPolicy | None:
        """Return the tracker of a policy's lambda; None if it has none, or a set one."""
        if not _open(policy) or self.plans is None:
            return None
        self._caution(policy)
        return TrackedPolicy(policy.informed(self.prior), Tracker(self.scores[policy], self.epsilon))

    def _caution(self, policy: Policy) -> float:
        if self.plans is None:
            return CAUTION
        if policy not in self.calibrations:
            self.scores[policy] = scores(policy.informed(self.prior), self.plans)
            last_s = self.plans.arrival_s[-1]
            self.calibrations[policy] = choose(self.scores[policy], self.epsilon, self.guarantee, last_s)
        return self.calibrations[policy].caution

    def facts(self, setting: PlanSetting) -> dict[str, Any]:
        """Return the calibrations as plain data, stream-to-act's by the setting's name, others by the cell's."""
        named = {canonical(policy.name, policy): found for policy, found in self.calibrations.items()}
        return {
            setting.name if name == ONLINE else f"{setting.name}/{name}": asdict(found)
            | {"caution": finite(found.caution)}
            for name, found in named.items()
        }


def _open(policy: Policy) -> bool:
    return policy.learns and policy.caution is None


def finite(caution: float | None) -> float | None:
    """Return lambda, or None if it is infinite: JSON has no infinity."""
    return None if caution is None or caution == float("inf") else caution


def learn(case: PlanCase, plan: LearningPlan) -> Knowledge:
    """Learn a prior, and get plans for calibration, from drawn plans of the same kind or recorded answers.

    If nothing is random the prior is as certain as the arrivals, and the online rule starts at S0.
    """
    plans = None
    if plan.answers:
        plans = plans_of(case, plan)
        prior = GapPrior.fit(plans.token_s)  # type: ignore[arg-type]  # recorded plans have tokens
    elif plan.random:
        count = max(case.tokens, 3)  # a spread needs two gaps
        rng = generator(plan.seed, "timeline", "prior", case.setting.key)
        prior = GapPrior.fit(case.board.tokens(count, rng, plan.calibration_plans))
        _, plans = draw(case, plan.seed, plan.calibration_plans, "calibration")
    else:
        prior = GapPrior(1 / case.board.tokens_per_s, LEAST_CV, LEAST_CV)
    return Knowledge(prior, plans, plan.epsilon, plan.guarantee)


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


@dataclass(slots=True)
class Following:
    """The policies of one setting by name, and the trackers of their lambda."""

    shape: PlanShape
    made: Mapping[str, Policy]
    tracked: dict[str, TrackedPolicy] = field(default_factory=dict)

    def policies(self) -> dict[str, Policy]:
        return {name: self.tracked[name].policy if name in self.tracked else each for name, each in self.made.items()}

    def learn(self, records: Sequence[Record]) -> None:
        """Learn from the records of an executed plan; an incomplete one is ignored."""
        for record in records:
            plan = observed(record, self.shape)
            if plan is not None and record.policy in self.tracked:
                stalled = any(stall_ns > TOLERANCE_S * 1e9 for stall_ns in record.stalls_ns)
                self.tracked[record.policy].learn(plan, stalled=stalled)


@dataclass(frozen=True, slots=True)
class LivePolicies:
    """Policies by name that execute a model's plans; lambda is tracked, not calibrated."""

    made: Mapping[str, Policy]
    seed: int
    epsilon: float = EPSILON
    track: bool = False
    """Whether policies whose lambda is not set follow it from plan to plan."""

    def prepare(self, shape: PlanShape, prior: GapPrior | None) -> Following:
        """Give online policies the prior, and a lambda unless it is set."""
        made, tracked = dict(self.made), {}
        for name, policy in self.made.items():
            made[name] = policy.informed(prior)
            if _open(policy) and self.track:
                plans = drawn(made[name].prior, shape, generator(self.seed, "tracking", shape.key), PLANS)
                tracked[name] = TrackedPolicy.begin(made[name], plans, self.epsilon)
            elif _open(policy):
                made[name] = policy.informed(prior, CAUTION)
        return Following(shape, made, tracked)


def drawn(prior: GapPrior, shape: PlanShape, rng: np.random.Generator, plans: int) -> Plans:
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
