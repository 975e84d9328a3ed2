"""Calibrate lambda, the caution, on recorded plans so that at most a share epsilon stalls, and track it.

A plan's *score* is the least caution from which on it does not stall: at that lambda and at every greater one of
GRID. "Stalls at lambda or at a greater one" is a loss of 0 or 1 that cannot grow with lambda, as conformal risk
control requires. With n exchangeable plans, choosing the least lambda at which r of them stall makes

- the expected share of stalls among further plans at most (r + 1) / (n + 1): conformal risk control (Angelopoulos,
  Bates, Fisch, Lei and Schuster, ICLR 2024, arXiv 2208.02814, theorem 1), here the split conformal quantile;
- that share, for the lambda at hand rather than on average over calibrations, at most x with confidence
  1 - P(Bin(n, x) <= r): a risk-controlling prediction set (Bates et al., J. ACM 2021, arXiv 2101.02703).

Exchangeable: every order of the scores is equally likely, as of independent ones. Scores that follow one another's
level are not, nor are those of a machine that has changed: the lag-1 correlation r1 of the calibration's delays, in the
order of measurement, shows the first (`Calibration.exchangeable`), a comparison with later ones the second.

`calibrate` takes the greatest r that keeps the `Guarantee`. *expected* keeps the first at epsilon or less, on average
over calibrations. *high-confidence*, the default, also keeps the second at 2 epsilon with 99.9 % confidence, because a
robot calibrated once keeps that one lambda. With epsilon = 1 %, 400 plans give r = 3 and r = 0, a rule that stalls in
0.25 % of the plans on average; 1000 plans give r = 9 and r = 7. The prior may have been fitted to the scored plans; the
first bound is exact if it was fitted to other plans.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import UsageError
from s2a_bench.options import option
from s2a_bench.policy import Floats, Plans, Policy, Schedule
from s2a_bench.policy.metrics import stalls

EPSILON: Final = 0.01
"""Share of plans that may stall."""
PLANS: Final = 400
"""Recommended number of plans; from 342 on the second bound holds for epsilon = 1 %."""
ANY_STALL_S: Final = 1e-6
"""Any longer gap between skills is a stall, a robot noticing it or not; shorter ones are rounding."""
CEILING: Final = 2.0
"""Bound on the true share of stalls for one calibration, over epsilon ..."""
CONFIDENCE: Final = 0.999
"""... with this confidence."""
GRID: Final = (*(i / 4 for i in range(17)), 4.5, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 16.0, 24.0, 32.0)
"""Values of lambda that are tried; beyond them the robot waits for the whole plan."""
CAUTIONS: Final = (*GRID, math.inf)
AT_ONCE: Final = 512
"""Plans decided at every lambda in one pass, limited by memory."""
Guarantee: TypeAlias = Literal["high-confidence", "expected"]
"""The quantity that epsilon bounds; see the module docstring."""
GUARANTEE: Final[Any] = option(
    "high-confidence",
    "what epsilon bounds: expected (the mean over calibrations), high-confidence (also 2 epsilon for this one, 99.9 %)",
)
"""The option of whatever calibrates."""
CHANCE: Final = 2.58
"""Greatest absolute r1 by chance, over 1 / sqrt(n): 1 % of independent delays correlate more."""
ROUNDING: Final = 1e-9
"""A product this close below a whole number counts as whole."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibrated lambda and its bounds for further plans of the same kind."""

    caution: float
    """lambda; infinity if only waiting for the whole plan is safe enough."""
    epsilon: float
    plans: int
    stalled: int
    """Calibration plans that stall at this or a greater caution."""
    expected_risk: float
    """Bound on P(any stall) of a further plan, on average over calibrations; at most epsilon."""
    risk: float
    """Bound on P(any stall) at this caution, with ``confidence``."""
    confidence: float
    guarantee: Guarantee = "high-confidence"
    correlation: float | None = None
    """r1, the lag-1 correlation of the delays in the order of measurement; None if unknown."""
    changed: bool = False
    """Whether later delays differed from those of the calibration."""

    @property
    def chance(self) -> float:
        return CHANCE / math.sqrt(self.plans)

    @property
    def exchangeable(self) -> bool:
        """Return False if the bounds do not hold: neighbouring delays correlate beyond chance, or delays changed."""
        return not self.changed and abs(self.correlation or 0.0) <= self.chance

    @property
    def lag_one(self) -> str:
        return f"lag-1 correlation {self.correlation:.3f}, by chance up to {self.chance:.3f}"


def promise(calibrations: Mapping[str, Mapping[str, Any]], what: str, unit: str) -> str:
    """Return the share of future ``unit`` (plural) that may stall under ``what``, by the weakest calibration.

    Calibrations are plain data; one whose scores are not exchangeable promises nothing, and the sentence says so.
    """
    kept = [each for each in (Calibration(**facts) for facts in calibrations.values()) if each.exchangeable]
    if not kept:
        return no_promise(calibrations)
    worst = max(kept, key=lambda each: each.expected_risk)
    closest = max(kept, key=lambda each: abs(each.correlation or 0.0))
    measured = "" if closest.correlation is None else f" ({closest.lag_one})"
    sentence = (
        f"--guarantee {worst.guarantee}: {what} lets at most {worst.expected_risk:.2%} of the {unit} stall on average, "
        f"{worst.risk:.2%} with {worst.confidence:.1%} confidence (epsilon {worst.epsilon:g}), if they are "
        f"exchangeable with those of the calibration{measured}."
    )
    return " ".join(filter(None, (sentence, no_promise(calibrations))))


def no_promise(calibrations: Mapping[str, Mapping[str, Any]]) -> str:
    """Return which calibrations promise nothing, as their scores are not exchangeable; empty for none."""
    broken = ", ".join(
        f"{name} ({'changed since the calibration' if each.changed else each.lag_one})"
        for name, each in ((name, Calibration(**facts)) for name, facts in calibrations.items())
        if not each.exchangeable
    )
    return f"No promise about stalls, because the delays are not exchangeable: {broken}." if broken else ""


def scores(policy: Policy, plans: Plans) -> Floats:
    """Return each plan's score, shape (M,): the least caution of GRID from which on it has no stall, else infinity."""
    return _least(np.stack([stalled(policy.informed(caution=caution).schedule(plans)) for caution in GRID]))


def check(plans: int, epsilon: float = EPSILON) -> None:
    """Raise UsageError if so few plans allow no bound of ``epsilon``."""
    if not 0 < epsilon < 1:
        raise UsageError(f"`epsilon`: {epsilon:g} should be between 0 and 1")
    if plans < fewest(epsilon):
        raise UsageError(
            f"`epsilon`: calibrating on {plans} promises {1 / (plans + 1):.2g} at best, not {epsilon:g}: "
            f"take {fewest(epsilon)} or more ({PLANS} are better), or raise `epsilon`"
        )


def fewest(epsilon: float) -> int:
    """Return the least number of plans, or latencies, for a bound of ``epsilon``."""
    return math.ceil(1 / epsilon - ROUNDING) - 1


def calibrate(
    policy: Policy, plans: Plans, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence"
) -> Calibration:
    """Find lambda for P(any stall) <= ``epsilon`` from recorded plans; raises UsageError for too few plans."""
    return choose(scores(policy, plans), epsilon, guarantee, plans.arrival_s[-1])


def may_stall(plans: int, epsilon: float, guarantee: Guarantee) -> int:
    """Return r, the number of calibration plans that may stall."""
    from scipy import stats

    most = math.floor((plans + 1) * epsilon + ROUNDING) - 1
    if guarantee == "high-confidence":
        while most and stats.binom.cdf(most, plans, min(CEILING * epsilon, 1.0)) > 1 - CONFIDENCE:
            most -= 1
    return most


def choose(
    score: Floats, epsilon: float = EPSILON, guarantee: Guarantee = "high-confidence", delay: Floats | None = None
) -> Calibration:
    """Find lambda from scores, shape (plans,); raises UsageError for too few scores.

    ``delay`` has the delay behind each score, such as a plan's last arrival, in order of measurement.
    """
    from s2a_bench.stats.batches import lag_one

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
        correlation=None if delay is None else lag_one(delay),
    )


class Tracker:
    """Follow lambda from plan to plan while the machine drifts: adaptive conformal inference.

    The level alpha, the share of recent scores that may lie above lambda, moves by ``step`` (epsilon - stalled) after
    every plan. If no score may lie above, lambda is infinite and the robot waits for the next plan, which cannot stall.
    So among T plans the share that stalls exceeds epsilon by at most (alpha_1 + step) / (step T), whatever the machine
    does (Gibbs and Candes, NeurIPS 2021, arXiv 2106.00170, proposition 4.1). The scores are those of the most recent
    plans, as many as at the beginning, so lambda also follows the caution that the machine needs now.
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
        count = len(self._sorted)
        above = min(math.floor((count + 1) * self.level + ROUNDING), count) - 1
        return math.inf if above < 0 else self._sorted[count - 1 - above]

    def learn(self, score: float, *, stalled: bool) -> None:
        """Update the level with whether a plan stalled, and the scores with the score of its recorded arrivals.

        The level stays at 2 epsilon or below, so that a long time without stalls does not make the rule careless.
        """
        self.level = min(self.level + self.step * (self.epsilon - stalled), CEILING * self.epsilon)
        self._scores.append(score)
        insort(self._sorted, score)
        del self._sorted[bisect_left(self._sorted, self._scores.popleft())]


@dataclass(slots=True)
class TrackedPolicy:
    """Lambda tracked from plan to plan: a robot keeps one as long as its machine stays the same.

    Before each plan it takes `policy`; afterwards it passes the recorded arrivals, from which the plan's score follows,
    and whether the plan stalled. `follow` does the same for arrays of plans.
    """

    base: Policy
    """The policy with its prior; its lambda does not matter."""
    tracker: Tracker

    @staticmethod
    def begin(policy: Policy, plans: Plans, epsilon: float = EPSILON) -> TrackedPolicy:
        return TrackedPolicy(policy, Tracker(scores(policy, plans), epsilon))

    @property
    def policy(self) -> Policy:
        return self.base.informed(caution=self.tracker.caution)

    def learn(self, plan: Plans, *, stalled: bool) -> None:
        self.tracker.learn(float(scores(self.base, plan)[0]), stalled=stalled)

    def follow(self, plans: Plans) -> tuple[Floats, Schedule]:
        """Decide plans one after another, learning from each; return each plan's lambda and the schedule.

        Blocks of plans are decided at every lambda in one pass; then lambda is chosen plan by plan.
        """
        cautions, starts, durations = [], [], []
        count = plans.arrival_s.shape[1]
        for places in np.array_split(np.arange(count), -(-count // AT_ONCE)):
            every = self.base.schedules(take(plans, places), CAUTIONS)
            stall = stalled(every)
            ranks = np.empty(places.size, dtype=np.intp)
            for place, score in enumerate(_least(stall).tolist()):
                ranks[place] = CAUTIONS.index(self.tracker.caution)
                self.tracker.learn(score, stalled=bool(stall[ranks[place], place]))
            cautions += [CAUTIONS[rank] for rank in ranks]
            columns = np.arange(places.size)
            starts.append(every.start_s[:, ranks, columns])
            durations.append(every.duration_s[:, ranks, columns])
        return np.array(cautions), Schedule(np.concatenate(starts, axis=1), np.concatenate(durations, axis=1))


def _least(stall: NDArray[np.bool_]) -> Floats:
    """Return each plan's score from whether it stalls at each of GRID, or of CAUTIONS."""
    above = len(stall) - np.argmax(stall[::-1], axis=0)
    ranks = np.where(stall.any(axis=0), above, 0)
    return np.array(CAUTIONS)[np.minimum(ranks, len(CAUTIONS) - 1)]


def upper_bound(stalled: float, plans: float, confidence: float) -> float:
    """Return the share x with P(Bin(plans, x) <= stalled) = 1 - confidence (Clopper and Pearson, Biometrika 1934)."""
    from scipy import stats

    return 1.0 if stalled == plans else float(stats.beta.ppf(confidence, stalled + 1, plans - stalled))


def interval(seen: float, of: float) -> tuple[float, float]:
    """Return the two-sided 95 % interval of a share, by `upper_bound`."""
    return 1 - upper_bound(of - seen, of, 0.975), upper_bound(seen, of, 0.975)


def stalled(schedule: Schedule) -> NDArray[np.bool_]:
    """Return a mask of the plans with any stall, shape (M,)."""
    return np.asarray((stalls(schedule) > ANY_STALL_S).any(axis=0))


def take(plans: Plans, columns: NDArray[np.intp]) -> Plans:
    """Return the plans of these columns; an array of one column stands for all plans."""
    arrays = {name: getattr(plans, name) for name in ("arrival_s", "nominal_s", "least_s", "most_s", "token_s")}
    wide = {name: rows for name, rows in arrays.items() if rows is not None and rows.shape[1] > 1}
    return replace(plans, **{name: rows[:, columns] for name, rows in wide.items()})
