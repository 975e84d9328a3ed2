"""The rows of timelines: `Plans` and `Schedule` in seconds from the request, computed or executed, as table rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.cells import COUNT, FLAG, TIME, Metric
from s2a_bench.experiments.timeline.rows import METRICS, TimelineRow
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.rows import KEPT_PLANS
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.metrics import measure, peak_jerk, rms_jerk, sparc, speed_profile
from s2a_bench.policy.schedule import align, least_end, safe_start

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

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
    caution: float | Sequence[float | None] | None = None,
    tolerance_s: float = ANY_STALL_S,
) -> list[TimelineRow]:
    """Return the rows of M timelines; gaps up to ``tolerance_s`` are no stall for ``any_stall``.

    ``caution`` is one lambda, or one a plan. Motion is computed for plans below `KEPT_PLANS`.
    """
    found = metrics_of(plans, schedule, tolerance_s=tolerance_s)
    shared = asdict(setting)
    rows = []
    for place, request_id in enumerate(request_ids):
        plan = first_plan + place
        motion = _motion(schedule, plans.nominal_s, place) if plan < KEPT_PLANS else {}
        rows.append(
            TimelineRow(
                cell=f"{setting.name}/{policy}",
                policy=policy,
                **shared,
                plan=plan,
                request_id=request_id,
                requested_ns=requested_ns[place] if requested_ns else 0,
                caution=caution[place] if isinstance(caution, Sequence) else caution,
                **{METRICS[name].column: _stored(METRICS[name], values[place]) for name, values in found.items()},
                **motion,
            )
        )
    return rows


def metrics_of(plans: Plans, schedule: Schedule, *, tolerance_s: float) -> dict[str, NDArray[Any]]:
    """Return the metrics of M timelines without motion: arrays of shape (M,), times in s."""
    arrival_s, nominal_s, least_s = align(plans.arrival_s, plans.nominal_s, plans.least_s)
    found = measure(plans, schedule)
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


def _stored(metric: Metric, value: float) -> int | float | bool:
    if metric.kind == TIME:
        return round(float(value) * 1e9)
    if metric.kind == COUNT:
        return int(value)
    if metric.kind == FLAG:
        return bool(value)
    # Times are exact to a nanosecond: smaller shares are rounding errors; adding 0.0 turns -0.0 into 0.0.
    return round(float(value), 9) + 0.0


def _motion(schedule: Schedule, nominal_s: Floats, place: int) -> dict[str, float]:
    """Return jerk and smoothness of one timeline in the model of `speed_profile`; empty if too long or too short."""
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
