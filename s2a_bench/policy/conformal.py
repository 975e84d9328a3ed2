"""How cautious to be: calibrate lambda on recorded plans so that stalls are as rare as asked, and track it.

A plan's *score* is the least caution from which on it does not stall: at that lambda and at every greater one of
GRID. "Stalls at lambda or at a greater one" is a loss of 0 or 1 that cannot grow with lambda, as conformal risk
control wants it. With n exchangeable plans, choosing the least lambda at which r of them stall makes

- the expected share of stalls among further plans at most (r + 1) / (n + 1): conformal risk control (Angelopoulos,
  Bates, Fisch, Lei and Schuster, ICLR 2024, arXiv 2208.02814, theorem 1), here the split conformal quantile;
- that share, for the lambda at hand rather than on average over calibrations, at most x with confidence
  1 - P(Bin(n, x) <= r): a risk-controlling prediction set (Bates et al., J. ACM 2021, arXiv 2101.02703).

`calibrate` takes the greatest r that keeps the `Guarantee`. *expected* keeps the first at epsilon or less: epsilon
means epsilon, on average over calibrations. *high-confidence*, the default, also keeps the second at 2 epsilon with
99.9 % confidence: whoever calibrates once lives with that one lambda. With epsilon = 1 %, 400 plans give r = 3 and
r = 0, a rule that stalls in .25 % of the plans on average; 1000 plans give r = 9 and r = 7. The scores come from plans
that the prior may have been fitted to; with a prior of its own plans the first bound is exact.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats, Plans, Policy

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

EPSILON: Final = 0.01
"""Share of plans that may stall."""
PLANS: Final = 400
"""As many should be recorded: with 342 or more one calibration is as good as promised."""
TOLERANCE_S: Final = 1e-6
"""Any longer gap between skills is a stall."""
CEILING: Final = 2.0
"""The share that one calibration may really have, over epsilon ..."""
CONFIDENCE: Final = 0.999
"""... with this confidence."""
GRID: Final = (*(i / 4 for i in range(17)), 4.5, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 16.0, 24.0, 32.0)
"""The values of lambda that are tried; beyond them a plan is waited for."""
Guarantee: TypeAlias = Literal["high-confidence", "expected"]
"""What epsilon bounds; see the module's head."""
GUARANTEES: Final[tuple[Guarantee, ...]] = get_args(Guarantee)
GUARANTEE: Final = (
    "what epsilon bounds: expected (the mean over calibrations), high-confidence (also 2 epsilon for this one, 99.9 %)"
)
"""The same for people who choose one."""
ROUNDING: Final = 1e-9
"""A product this close below a whole number is one."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """What calibration found, and what it promises for further plans of the same kind."""

    caution: float
    """lambda; infinity where nothing less than waiting for the whole plan is safe enough."""
    epsilon: float
    plans: int
    stalled: int
    """Calibration plans that stall with this caution or a greater one."""
    expected_risk: float
    """Bound on P(any stall) of a further plan, on average over calibrations; at most epsilon."""
    risk: float
    """Bound on P(any stall) with this caution, with ``confidence``."""
    confidence: float
    guarantee: Guarantee = "high-confidence"


def scores(policy: Policy, plans: Plans) -> Floats:
    """Return each plan's score, shape (M,): the least caution of GRID from which on it does not stall, else infinity.

    Tries the greatest caution first; a plan that has stalled is done.
    """
    import numpy as np

    count = plans.arrival_s.shape[1]
    score = np.full(count, GRID[0])
    left = np.arange(count)
    above = math.inf
    for caution in reversed(GRID):
        stalls = stalled(policy.informed(caution=caution), take(plans, left))
        score[left[stalls]] = above
        left, above = left[~stalls], caution
        if not left.size:
            break
    return score


def check(plans: int, epsilon: float = EPSILON) -> None:
    """Refuse to calibrate on so few plans that nothing can be promised; raises UsageError."""
    if not 0 < epsilon < 1:
        raise UsageError(f"`epsilon`: {epsilon:g} should be between 0 and 1")
    if plans < fewest(epsilon):
        raise UsageError(
            f"`epsilon`: calibrating on {plans} promises {1 / (plans + 1):.2g} at best, not {epsilon:g}: "
            f"take {fewest(epsilon)} or more ({PLANS} are better), or raise `epsilon`"
        )


def fewest(epsilon: float) -> int:
    """Return how many plans, or latencies, a promise of ``epsilon`` takes at least."""
    return math.ceil(1 / epsilon - ROUNDING) - 1


def coarse(plans: int, epsilon: float = EPSILON) -> bool:
    """Return whether these are too few plans for the second promise, even if none of them stalls: worth a warning."""
    return upper_bound(0, plans, CONFIDENCE) > CEILING * epsilon


def calibrate(
    policy: Policy, plans: Plans, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence"
) -> Calibration:
    """Find lambda for P(any stall) <= ``epsilon`` from recorded plans; see the module's head.

    Raises UsageError where so few plans allow no such promise.
    """
    return choose(scores(policy, plans), epsilon, guarantee)


def may_stall(plans: int, epsilon: float, guarantee: Guarantee) -> int:
    """Return r, how many of the calibration plans may stall."""
    from scipy import stats

    most = math.floor((plans + 1) * epsilon + ROUNDING) - 1
    if guarantee == "high-confidence":
        while most and stats.binom.cdf(most, plans, min(CEILING * epsilon, 1.0)) > 1 - CONFIDENCE:
            most -= 1
    return most


def choose(score: Floats, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence") -> Calibration:
    """Find lambda from scores, shape (plans,)."""
    import numpy as np

    count = score.size
    check(count, epsilon)
    above = may_stall(count, epsilon, guarantee)
    caution = float(np.sort(score)[count - 1 - above])
    return Calibration(
        caution=caution,
        epsilon=epsilon,
        plans=count,
        stalled=int(np.sum(score > caution)),
        expected_risk=(above + 1) / (count + 1),
        risk=upper_bound(above, count, CONFIDENCE),
        confidence=CONFIDENCE,
        guarantee=guarantee,
    )


class Tracker:
    """Follow lambda from plan to plan while the machine drifts: adaptive conformal inference.

    The level alpha, the share of recent scores that may lie above lambda, moves by ``step`` (epsilon - stalled) after
    every plan. Where it leaves no room, lambda is infinite and the next plan is waited for, which cannot stall; so
    among T plans the share that stalls exceeds epsilon by at most (alpha_1 + step) / (step T), whatever the machine
    does (Gibbs and Candes, NeurIPS 2021, arXiv 2106.00170, proposition 4.1). The scores are those of as many recent
    plans as there were to begin with, so that lambda also learns how much caution the machine needs now.
    """

    def __init__(self, score: Iterable[float], epsilon: float = EPSILON, *, step: float = 0.002) -> None:
        first = tuple(score)
        if not first:
            raise ValueError("tracking begins with the scores of a calibration")
        self.epsilon = epsilon
        self.step = step
        self.level = epsilon
        self._scores = deque(first)
        self._sorted = sorted(first)

    @property
    def caution(self) -> float:
        """Return lambda for the next plan."""
        count = len(self._sorted)
        above = min(math.floor((count + 1) * self.level + ROUNDING), count) - 1
        return math.inf if above < 0 else self._sorted[count - 1 - above]

    def learn(self, score: float, *, stalled: bool) -> None:
        """Learn how a plan went: whether it stalled, and its score, which its recorded arrivals tell afterwards.

        The level stays below 2 epsilon: a long calm must not use up the alertness.
        """
        self.level = min(self.level + self.step * (self.epsilon - stalled), CEILING * self.epsilon)
        self._scores.append(score)
        insort(self._sorted, score)
        del self._sorted[bisect_left(self._sorted, self._scores.popleft())]

    def state(self) -> dict[str, Any]:
        """Return level and scores as plain data; an infinite score is null."""
        scores = [None if math.isinf(score) else score for score in self._scores]
        return {"epsilon": self.epsilon, "step": self.step, "level": self.level, "scores": scores}

    @staticmethod
    def resume(state: Mapping[str, Any]) -> Tracker:
        """Go on from a state; raises KeyError, TypeError or ValueError for what is none."""
        scores = [math.inf if score is None else float(score) for score in state["scores"]]
        tracker = Tracker(scores, float(state["epsilon"]), step=float(state["step"]))
        tracker.level = float(state["level"])
        if not (0 < tracker.epsilon < 1 and 0 < tracker.step < 1 and math.isfinite(tracker.level)):
            raise ValueError(f"epsilon {tracker.epsilon:g}, step {tracker.step:g}, level {tracker.level:g}")
        if any(math.isnan(score) or score < 0 for score in scores):
            raise ValueError("a score below 0")
        return tracker


def upper_bound(stalled: int, plans: int, confidence: float) -> float:
    """Return the share x with P(Bin(plans, x) <= stalled) = 1 - confidence (Clopper and Pearson, Biometrika 1934).

    The upper end of their two-sided 95 % interval is the bound with confidence .975.
    """
    from scipy import stats

    return 1.0 if stalled == plans else float(stats.beta.ppf(confidence, stalled + 1, plans - stalled))


def stalled(policy: Policy, plans: Plans) -> NDArray[np.bool_]:
    """Return which plans stall at all, shape (M,)."""
    import numpy as np

    from s2a_bench.policy.metrics import stalls

    return np.asarray((stalls(policy.schedule(plans)) > TOLERANCE_S).any(axis=0))


def take(plans: Plans, columns: NDArray[np.intp]) -> Plans:
    """Take some of the plans."""

    def cut(rows: Floats | None) -> Any:
        return rows if rows is None or rows.shape[1] == 1 else rows[:, columns]

    names = ("arrival_s", "nominal_s", "least_s", "most_s", "token_s")
    return replace(plans, **{name: cut(getattr(plans, name)) for name in names})
