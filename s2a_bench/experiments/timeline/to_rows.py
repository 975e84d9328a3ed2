"""Timelines as rows: what a policy made of plans, computed or really executed, in the integers of a run folder.

Whoever has run plans (in virtual time, in real time or with a live model) hands over `Plans` and `Schedule` in
seconds from the request, and gets the rows that every table and figure of timelines is made of.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.timeline.metrics import METRICS
from s2a_bench.experiments.timeline.rows import PlanRow, SkillRow, TimelineRow
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.conformal import TOLERANCE_S
from s2a_bench.policy.metrics import measure, stalls
from s2a_bench.policy.motion import peak_jerk, rms_jerk, sparc, speed_profile
from s2a_bench.policy.schedule import align, least_end, safe_start
from s2a_bench.store.requests import TokenRow

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

KEPT_PLANS: Final = 10
"""As many plans of a cell keep their tokens, skills and motion; the others only their metrics."""

SAMPLE_S: Final = 0.01
"""How finely the speed is sampled that jerk and SPARC are taken from."""

SHORTEST_MOTION_S: Final = 1e-9
"""Shorter motions have no jerk and no SPARC: no sample of theirs moves."""
LONGEST_MOTION_S: Final = 1000.0
"""Longer motions have none of these: their samples would fill the memory."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What plans have in common, whatever the policy."""

    board: str
    """A profile's name; empty where only a rate was given."""
    title: str
    tokens_per_s: float
    prompt_s: float | None
    """c; None where a model took what it took."""
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    mode: str = "virtual"
    emulated: bool = True
    """Whether no model answered."""

    @property
    def name(self) -> str:
        """Name the setting; with a policy behind it, the cell."""
        board = self.board or f"{self.tokens_per_s:g}tps"
        return f"{board}/L{self.tokens_per_skill}/N{self.n_skills}/T{self.t_nom_s:g}"

    def request_id(self, plan: int, policy: str = "") -> str:
        """Name a request; policies that share arrivals share the request."""
        return f"{self.name}/{policy}/{plan}" if policy else f"{self.name}/{plan}"


def timeline_rows(
    setting: Setting,
    policy: str,
    plans: Plans,
    schedule: Schedule,
    request_ids: Sequence[str],
    *,
    first_plan: int = 0,
    requested_ns: Sequence[int] | None = None,
    caution: float | Sequence[float | None] | None = None,
    observed_s: float = 0.0,
    tolerance_s: float = TOLERANCE_S,
) -> list[PlanRow]:
    """Describe M timelines; ``tolerance_s`` is the longest gap that is no stall for ``any_stall`` (1 us unless told).

    ``caution`` is one lambda, or one a plan. Motion is computed for plans below `KEPT_PLANS`. ``observed_s`` is when
    the picture was taken, from the request.
    """
    found = metrics_of(plans, schedule, observed_s=observed_s, tolerance_s=tolerance_s)
    rows = []
    for place, request_id in enumerate(request_ids):
        plan = first_plan + place
        motion = _motion(schedule, plans.nominal_s, place) if plan < KEPT_PLANS else {}
        rows.append(
            TimelineRow(
                cell=f"{setting.name}/{policy}",
                policy=policy,
                board=setting.board,
                title=setting.title,
                mode=setting.mode,
                emulated=setting.emulated,
                tokens_per_s=setting.tokens_per_s,
                prompt_s=setting.prompt_s,
                tokens_per_skill=setting.tokens_per_skill,
                n_skills=setting.n_skills,
                t_nom_s=setting.t_nom_s,
                plan=plan,
                request_id=request_id,
                requested_ns=requested_ns[place] if requested_ns else 0,
                caution=caution[place] if isinstance(caution, Sequence) else caution,
                **{METRICS[name].column: METRICS[name].stored(values[place]) for name, values in found.items()},
                **motion,
            )
        )
    return rows


def metrics_of(plans: Plans, schedule: Schedule, *, observed_s: float, tolerance_s: float) -> dict[str, NDArray[Any]]:
    """Return the metrics of M timelines by their names, but for motion: arrays of shape (M,), times in s."""
    arrival_s, nominal_s, least_s = align(plans.arrival_s, plans.nominal_s, plans.least_s)
    found = measure(plans, schedule, observed_s=observed_s)
    safe_s = safe_start(arrival_s, nominal_s)
    return {
        **{name: getattr(found, name) for name in METRICS if hasattr(found, name)},
        "start_s": found.first_action_s,
        "safe_start_s": safe_s,
        "last_arrival_s": arrival_s[-1],
        "safe_end_s": safe_s + nominal_s.sum(axis=0),
        "least_end_s": least_end(arrival_s, least_s),
        "p_any_stall": found.longest_stall_s > tolerance_s,
    }


def skill_rows(
    cell: str,
    plans: Plans,
    schedule: Schedule,
    request_ids: Sequence[str],
    *,
    first_plan: int = 0,
    texts: Sequence[Sequence[str]] | None = None,
    due_s: Floats | None = None,
) -> list[SkillRow]:
    """List every skill of the plans that are kept; ``texts`` are the calls, a sequence a plan.

    ``due_s``, shape (N, M), says when there was reason to start each skill that was really executed.
    """
    arrival_s, nominal_s, least_s, most_s, start_s, duration_s = align(
        plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s, schedule.start_s, schedule.duration_s
    )
    end_s = start_s + duration_s
    stall_s = np.vstack([np.zeros(start_s.shape[1]), stalls(schedule)])
    rows = []
    for place, request_id in enumerate(request_ids[: max(KEPT_PLANS - first_plan, 0)]):
        for index in range(len(start_s)):
            at = (index, place)
            rows.append(
                SkillRow(
                    cell=cell,
                    request_id=request_id,
                    plan=first_plan + place,
                    index=index,
                    text=texts[place][index] if texts else "",
                    arrival_ns=to_ns(arrival_s[at]),
                    start_ns=to_ns(start_s[at]),
                    end_ns=to_ns(end_s[at]),
                    stall_ns=to_ns(stall_s[at]),
                    nominal_ns=to_ns(nominal_s[at]),
                    least_ns=to_ns(least_s[at]),
                    most_ns=to_ns(most_s[at]),
                    due_ns=None if due_s is None else to_ns(due_s[at]),
                )
            )
    return rows


def token_rows(cell: str, token_s: Floats, request_ids: Sequence[str]) -> Iterable[TokenRow]:
    """List every token of the plans that are kept, shape (tokens, M); nobody wrote them, so they have no text."""
    for place, request_id in enumerate(request_ids[:KEPT_PLANS]):
        for index, at_s in enumerate(token_s[:, place]):
            yield TokenRow(request_id, cell, index, -1, "", None, to_ns(at_s))


def to_ns(seconds: float) -> int:
    """Round to nanoseconds."""
    return round(float(seconds) * 1e9)


def _motion(schedule: Schedule, nominal_s: Floats, place: int) -> dict[str, float]:
    """Return jerk and smoothness of one timeline, under the model of `speed_profile`; none if too long or too short."""
    start_s, duration_s, nominal_s = (
        np.ascontiguousarray(values[:, place]) for values in align(schedule.start_s, schedule.duration_s, nominal_s)
    )
    if not SHORTEST_MOTION_S <= start_s[-1] + duration_s[-1] - start_s[0] <= LONGEST_MOTION_S:
        return {}
    speed = speed_profile(start_s, duration_s, nominal_s, SAMPLE_S)
    return {
        "rms_jerk": rms_jerk(speed, SAMPLE_S),
        "peak_jerk": peak_jerk(speed, SAMPLE_S),
        "sparc": sparc(speed, SAMPLE_S),
    }
