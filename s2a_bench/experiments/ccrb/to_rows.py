"""Roll-outs as rows: what was tried and what became of it, in the columns of a run folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from s2a_bench.experiments.ccrb.rows import RolloutRow, TrajectoryRow
from s2a_bench.experiments.timeline.to_rows import to_ns
from s2a_bench.policy import Schedule
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.motion import peak_jerk, rms_jerk, sparc
from s2a_bench.scenario import EGO, LEAD, REAR
from s2a_bench.scenario.ccrb.drive import Trajectory
from s2a_bench.scenario.ccrb.ego import PHASES
from s2a_bench.scenario.ccrb.outcome import Outcomes

_TOLERANCE_S = 0.02
"""Shorter stalls do not count (POLICY section 1)."""
_METRICS = ("min_front_gap_m", "min_rear_gap_m", "min_front_ttc_s", "min_rear_ttc_s", "required_decel_mps2")


def rollout_rows(
    about: Mapping[str, Any], schedule: Schedule, outcomes: Outcomes, *, motion: Mapping[str, Any] | None = None
) -> Iterator[RolloutRow]:
    """Describe M roll-outs; what ``about`` says is one value for all, or an array with one each."""
    stall_s = stalls(schedule)
    rollouts = len(outcomes.code)
    end_s = schedule.start_s[-1] + schedule.duration_s[-1]
    shared = {name: value for name, value in about.items() if not isinstance(value, np.ndarray)}
    own = {name: value for name, value in about.items() if isinstance(value, np.ndarray)}
    for place in range(rollouts):
        metrics: dict[str, Any] = {name: _finite(getattr(outcomes, name)[place]) for name in _METRICS}
        yield RolloutRow(
            **shared,
            **{name: value[place].item() for name, value in own.items()},
            start_ns=to_ns(schedule.start_s[0, place]),
            end_ns=to_ns(end_s[place]),
            stalls=int((stall_s[:, place] > _TOLERANCE_S).sum()),
            stall_ns=to_ns(stall_s[:, place].sum()),
            outcome=outcomes.name(place),
            impact_speed_mps=_finite(outcomes.impact_mps[place]),
            front_impact_mps=_finite(outcomes.front_impact_mps[place]),
            rear_impact_mps=_finite(outcomes.rear_impact_mps[place]),
            **metrics,
            **(motion or {}),
        )


def motion_of(path: Trajectory) -> dict[str, float]:
    """Return jerk and smoothness of the ego of a single roll-out, from the request until it rests or crashes."""
    speed = path.speed_mps[:, EGO, 0]
    if len(speed) < 3:  # noqa: PLR2004 - over at once
        return {}
    step_s = float(path.time_s[1])
    return {"rms_jerk": rms_jerk(speed, step_s), "peak_jerk": peak_jerk(speed, step_s), "sparc": sparc(speed, step_s)}


def trajectory_rows(cell: str, path: Trajectory) -> Iterator[TrajectoryRow]:
    """List every recorded moment of a single roll-out."""
    position, speed, acceleration = (
        values[..., 0] for values in (path.position_m, path.speed_mps, path.acceleration_mps2)
    )
    for place, at_s in enumerate(path.time_s):
        yield TrajectoryRow(
            cell=cell,
            at_ns=to_ns(at_s),
            phase=PHASES[int(path.phase[place, 0])],
            skill=int(path.skill[place, 0]),
            lead_position_m=float(position[place, LEAD]),
            ego_position_m=float(position[place, EGO]),
            rear_position_m=float(position[place, REAR]),
            ego_lateral_m=float(path.lateral_m[place, EGO, 0]),
            lead_speed_mps=float(speed[place, LEAD]),
            ego_speed_mps=float(speed[place, EGO]),
            rear_speed_mps=float(speed[place, REAR]),
            lead_acceleration_mps2=float(acceleration[place, LEAD]),
            ego_acceleration_mps2=float(acceleration[place, EGO]),
            rear_acceleration_mps2=float(acceleration[place, REAR]),
        )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
