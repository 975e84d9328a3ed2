"""Lambda tracked from plan to plan: a policy that learns from every plan it has decided.

A robot keeps one `TrackedPolicy` as long as its machine stays the same. Before each plan it takes
`TrackedPolicy.policy`; afterwards it passes the recorded arrivals, from which the plan's score follows, and whether the
plan stalled. `TrackedPolicy.follow` does the same for arrays of plans. `conformal.Tracker` has the rule and its bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.policy import Floats, Plans, Policy, Schedule
from s2a_bench.policy.conformal import ANY_STALL_S, EPSILON, GRID, Tracker, scores, take
from s2a_bench.policy.metrics import stalls as stalls_of

CAUTIONS: Final = (*GRID, float("inf"))
AT_ONCE: Final = 512
"""Plans decided at every lambda in one pass, limited by memory."""


@dataclass(slots=True)
class TrackedPolicy:
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
        self.tracker.learn(float(scores(self.made, plan)[0]), stalled=stalled)

    def follow(self, plans: Plans) -> tuple[Floats, Schedule]:
        """Decide plans one after another, learning from each; return each plan's lambda and the schedule.

        Blocks of plans are decided at every lambda in one pass; then lambda is chosen plan by plan.
        """
        chosen, starts, durations = [], [], []
        count = plans.arrival_s.shape[1]
        for places in np.array_split(np.arange(count), -(-count // AT_ONCE)):
            every = self.made.schedules(take(plans, places), CAUTIONS)
            stalls = np.asarray((stalls_of(every) > ANY_STALL_S).any(axis=0))
            ranks = np.empty(places.size, dtype=np.intp)
            for place, score in enumerate(_least(stalls)):
                ranks[place] = CAUTIONS.index(self.tracker.caution)
                self.tracker.learn(score, stalled=bool(stalls[ranks[place], place]))
            chosen += [CAUTIONS[rank] for rank in ranks]
            columns = np.arange(places.size)
            starts.append(every.start_s[:, ranks, columns])
            durations.append(every.duration_s[:, ranks, columns])
        return np.array(chosen), Schedule(np.concatenate(starts, axis=1), np.concatenate(durations, axis=1))


def _least(stalls: NDArray[np.bool_]) -> list[float]:
    """Return each plan's score: the least lambda from which on it does not stall."""
    above = len(CAUTIONS) - np.argmax(stalls[::-1], axis=0)
    ranks = np.where(stalls.any(axis=0), above, 0)
    return [CAUTIONS[min(rank, len(CAUTIONS) - 1)] for rank in ranks]
