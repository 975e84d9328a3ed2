"""Lambda from plan to plan: a policy that learns from every plan that it has decided.

A robot keeps one `Tracked` for as long as its machine stays the same. Before each plan it takes `Tracked.policy`, after
it tells what came and whether the plan stalled: the plan's score is what its recorded arrivals say afterwards.
`follow` does the same for arrays of plans. See `conformal.Tracker` for the rule and its bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.conformal import EPSILON, GRID, TOLERANCE_S, Tracker, scores, take
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import StreamToAct

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

CAUTIONS: Final = (*GRID, float("inf"))
AT_ONCE: Final = 512
"""Plans that are decided at every lambda at once; they fit the memory."""


@dataclass(slots=True)
class Tracked:
    """A policy and the tracker of its lambda."""

    made: StreamToAct
    """The policy with its prior; its lambda does not matter."""
    tracker: Tracker

    @staticmethod
    def begin(policy: StreamToAct, plans: Plans, epsilon: float = EPSILON) -> Tracked:
        """Begin with calibration plans."""
        return Tracked(policy, Tracker(scores(policy, plans), epsilon))

    @property
    def policy(self) -> StreamToAct:
        """Return the policy for the next plan."""
        return replace(self.made, caution=self.tracker.caution)

    def learn(self, plan: Plans, *, stalled: bool) -> None:
        """Learn from a plan, one column with ``token_s`` and ``shape``, and from whether it stalled."""
        self.tracker.learn(float(scores(self.made, plan)[0]), stalled=stalled)

    def follow(self, plans: Plans) -> tuple[Floats, Schedule]:
        """Decide plans one after another, learning from each; returns each plan's lambda and the schedule.

        What some plans would do at every lambda is computed at once, and lambda is picked from it plan by plan.
        """
        import numpy as np

        chosen, parts = [], []
        count = plans.arrival_s.shape[1]
        for places in np.array_split(np.arange(count), -(-count // AT_ONCE)):
            every = at_every_caution(self.made, take(plans, places))
            stalls = _stalls(every)
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
        """Return what another run needs to go on, as plain data."""
        prior = self.made.prior
        return {
            "prior": {"mean_s": prior.mean_s, "plan_cv": prior.plan_cv, "token_cv": prior.token_cv},
            **self.tracker.state(),
        }

    @staticmethod
    def resume(policy: StreamToAct, state: Mapping[str, Any]) -> Tracked:
        """Go on from a state; raises UsageError for what is none."""
        try:
            prior = GapPrior(**{name: float(value) for name, value in state["prior"].items()})
            return Tracked(replace(policy, prior=prior), Tracker.resume(state))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UsageError(f"holds no state of tracking ({type(error).__name__}: {error})") from error


def at_every_caution(policy: StreamToAct, plans: Plans) -> Schedule:
    """Return how each plan would go at each lambda: arrays of shape (N, lambdas, M)."""
    import numpy as np

    from s2a_bench.policy.online import schedule

    count = plans.arrival_s.shape[1]
    copies = take(plans, np.tile(np.arange(count), len(CAUTIONS)))
    found = schedule(policy.prior, np.repeat(CAUTIONS, count), copies, policy.rule)
    shape = (-1, len(CAUTIONS), count)
    return Schedule(found.start_s.reshape(shape), found.duration_s.reshape(shape))


def _stalls(every: Schedule) -> NDArray[np.bool_]:
    """Return which plans stall at which lambda, shape (lambdas, M)."""
    import numpy as np

    gaps_s = every.start_s[1:] - every.start_s[:-1] - every.duration_s[:-1]
    return np.asarray((gaps_s > TOLERANCE_S).any(axis=0))


def _least(stalls: NDArray[np.bool_]) -> list[float]:
    """Return the least lambda from which on each plan does not stall."""
    import numpy as np

    above = len(CAUTIONS) - np.argmax(stalls[::-1], axis=0)
    ranks = np.where(stalls.any(axis=0), above, 0)
    return [CAUTIONS[min(rank, len(CAUTIONS) - 1)] for rank in ranks]
