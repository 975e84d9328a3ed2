"""Lambda from plan to plan: a policy that learns from every plan that it has decided.

A robot keeps one `TrackedPolicy` for as long as its machine stays the same. Before each plan it takes
`TrackedPolicy.policy`, after it tells what came and whether the plan stalled: the plan's score is what its recorded
arrivals say afterwards.
`follow` does the same for arrays of plans. See `conformal.Tracker` for the rule and its bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats, Plans, Policy, Schedule
from s2a_bench.policy.conformal import EPSILON, GRID, TOLERANCE_S, Tracker, scores, take
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import stalls as stalls_of

CAUTIONS: Final = (*GRID, float("inf"))
AT_ONCE: Final = 512
"""Plans that are decided at every lambda at once; they fit the memory."""


@dataclass(slots=True)
class TrackedPolicy:
    """A policy and the tracker of its lambda."""

    made: Policy
    """The policy with its prior; its lambda does not matter."""
    tracker: Tracker

    @staticmethod
    def begin(policy: Policy, plans: Plans, epsilon: float = EPSILON) -> TrackedPolicy:
        return TrackedPolicy(policy, Tracker(scores(policy, plans), epsilon))

    @property
    def policy(self) -> Policy:
        return self.made.informed(caution=self.tracker.caution)

    def learn(self, plan: Plans, *, stalled: bool) -> None:
        """Learn from a plan, one column with ``token_s`` and ``shape``, and from whether it stalled."""
        self.tracker.learn(float(scores(self.made, plan)[0]), stalled=stalled)

    def follow(self, plans: Plans) -> tuple[Floats, Schedule]:
        """Decide plans one after another, learning from each; returns each plan's lambda and the schedule.

        What some plans would do at every lambda is computed at once, and lambda is picked from it plan by plan.
        """
        chosen, parts = [], []
        count = plans.arrival_s.shape[1]
        for places in np.array_split(np.arange(count), -(-count // AT_ONCE)):
            every = self.made.schedules(take(plans, places), CAUTIONS)
            stalls = np.asarray((stalls_of(every) > TOLERANCE_S).any(axis=0))
            ranks = np.empty(places.size, dtype=np.intp)
            for place, score in enumerate(_least(stalls)):
                ranks[place] = CAUTIONS.index(self.tracker.caution)
                self.tracker.learn(score, stalled=bool(stalls[ranks[place], place]))
            chosen += [CAUTIONS[rank] for rank in ranks]
            columns = np.arange(places.size)
            parts.append((every.start_s[:, ranks, columns], every.duration_s[:, ranks, columns]))
        start_s, duration_s = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
        return np.array(chosen), Schedule(start_s, duration_s)

    def state(self) -> dict[str, Any]:
        return {"prior": asdict(self.made.prior), **self.tracker.state()}

    @staticmethod
    def resume(policy: Policy, state: Mapping[str, Any]) -> TrackedPolicy:
        """Go on from a state; raises UsageError for what is none."""
        try:
            prior = GapPrior(**{name: float(value) for name, value in state["prior"].items()})
            return TrackedPolicy(policy.informed(prior), Tracker.resume(state))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UsageError(f"holds no state of tracking ({type(error).__name__}: {error})") from error


def _least(stalls: NDArray[np.bool_]) -> list[float]:
    """Return the least lambda from which on each plan does not stall."""
    above = len(CAUTIONS) - np.argmax(stalls[::-1], axis=0)
    ranks = np.where(stalls.any(axis=0), above, 0)
    return [CAUTIONS[min(rank, len(CAUTIONS) - 1)] for rank in ranks]
