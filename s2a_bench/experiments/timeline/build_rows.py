"""The rows of timelines: `Plans` and `Schedule` in seconds from the request, computed or executed, as table rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.cells import COUNT, TIME
from s2a_bench.experiments.timeline.rows import METRICS, TimelineRow
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.rows import KEPT_PLANS, to_ns
from s2a_bench.policy import Floats, Plans, Schedule
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.metrics import measure, motion, speed_profile
from s2a_bench.policy.schedule import align, least_end, safe_start

SAMPLE_S: Final = 0.01
SHORTEST_MOTION_S: Final = 1e-9
"""Shorter motions have no jerk and no SPARC: none of their samples moves."""
LONGEST_MOTION_S: Final = 1000.0
"""Longer motions have none either: their samples would fill the memory."""


def timeline_rows(
    setting: PlanSetting,
    policy: str,
    plans: Plans,
    schedule: Schedule,
    request_ids: Sequence[str],
    *,
    first_plan: int = 0,
    requested_ns: Sequence[int] | None = None,
    cautions: Sequence[float | None] | None = None,
    tolerance_s: float = ANY_STALL_S,
) -> list[TimelineRow]:
    """Return the rows of M timelines; gaps up to ``tolerance_s`` do not count for ``any_stall``.

    ``cautions`` has a lambda for each plan. Motion is computed for plans below `KEPT_PLANS`.
    """
    arrival_s, nominal_s, least_s = align(plans.arrival_s, plans.nominal_s, plans.least_s)
    safe_s = safe_start(arrival_s, nominal_s)
    safe_end_s, least_end_s = safe_s + nominal_s.sum(axis=0), least_end(arrival_s, least_s)
    of_plan, shared = measure(plans, schedule), asdict(setting)
    computed = [
        (metric.column, _STORED.get(metric.kind, share), getattr(of_plan, metric.name))
        for metric in METRICS.values()
        if hasattr(of_plan, metric.name)
    ]

    def row(place: int, request_id: str) -> TimelineRow:
        plan = first_plan + place
        moved = _motion(schedule, plans.nominal_s, place) if plan < KEPT_PLANS else {}
        return TimelineRow(
            cell=f"{setting.name}/{policy}",
            policy=policy,
            **shared,
            plan=plan,
            request_id=request_id,
            requested_ns=requested_ns[place] if requested_ns else 0,
            caution=cautions[place] if cautions else None,
            start_ns=to_ns(of_plan.first_action_s[place]),
            safe_start_ns=to_ns(safe_s[place]),
            last_arrival_ns=to_ns(arrival_s[-1, place]),
            safe_end_ns=to_ns(safe_end_s[place]),
            least_end_ns=to_ns(least_end_s[place]),
            any_stall=bool(of_plan.longest_stall_s[place] > tolerance_s),
            **{column: stored(values[place]) for column, stored, values in computed},
            **moved,
        )

    return [row(place, request_id) for place, request_id in enumerate(request_ids)]


def share(value: float) -> float:
    """Return a share without rounding errors: times are exact to a nanosecond; adding 0.0 turns -0.0 into 0.0."""
    return round(float(value), 9) + 0.0


_STORED: Final[dict[str, Callable[[float], Any]]] = {TIME: to_ns, COUNT: int}
"""Kind of a metric -> what makes its column of a value; of the others `share`."""


def _motion(schedule: Schedule, nominal_s: Floats, place: int) -> dict[str, Any]:
    """Return the `motion` of one timeline in the model of `speed_profile`; none if it is too long or too short."""
    start_s, duration_s, nominal_s = (
        np.ascontiguousarray(values[:, place]) for values in align(schedule.start_s, schedule.duration_s, nominal_s)
    )
    if not SHORTEST_MOTION_S <= start_s[-1] + duration_s[-1] - start_s[0] <= LONGEST_MOTION_S:
        return {}
    return motion(speed_profile(start_s, duration_s, nominal_s, SAMPLE_S), SAMPLE_S)
