"""The scenario: car-to-car rear braking (Euro NCAP CCRb) with a car behind; roles, numbers, plan and deadline.

Euro NCAP's test protocol for AEB car-to-car: both cars at 50 km/h, 12 or 40 m apart, and the lead brakes at 2 or
6 m/s^2. The trailing car is the paper's (section V-F). `drive` puts these cars into a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2a_bench.plan.skillset import Gap
from s2a_bench.policy import Floats, Plans, Schedule
from s2a_bench.policy.schedule import align, safe_start, work_conserving

KMH: Final = 1 / 3.6
NCAP_SPEED_MPS: Final = 50 * KMH
LEAD_JERK_MPS3: Final = 6.0
EGO_LEAST_MPS2: Final = -8.0
LEAST_IMPACT_MPS: Final = 0.5
"""Slower contacts do not count as impacts."""
SAFETY_M: Final = 2.0
"""Distance to the lead that the start deadline keeps."""
CAR_WIDTH_M: Final = 2.0
OUTCOMES: Final = ("none", "front", "rear", "both")
"""The outcomes by code: bit 0 is a front impact, bit 1 a rear impact."""
TTC: Final = "s2a-ttc"
FOLLOWERS: Final[dict[str, str]] = {
    "careful": "s2a_bench.scenario.ccrb.follower:Careful",
    "hdm": "s2a_bench.scenario.ccrb.follower:Hdm",
    "idm": "s2a_bench.scenario.ccrb.follower:Idm",
    "hybrid": "s2a_bench.scenario.ccrb.follower:Hybrid",
}


@dataclass(frozen=True, slots=True)
class Cars:
    """One scenario, or M of them where numbers are arrays of shape (M,)."""

    front_gap_m: ArrayLike = 40.0
    lead_decel_mps2: ArrayLike = 2.0
    rear_gap_m: ArrayLike = 14.0
    reaction_s: ArrayLike = 1.3
    """The trailing car acts on the state this long ago."""
    speed_mps: ArrayLike = NCAP_SPEED_MPS
    """v0 of all three."""
    gap: Gap | NDArray[np.str_] = "stop"
    """The ego's behaviour between skills; one name, or an array of them."""
    follower: str = "careful"
    """The trailing car's law, a name of FOLLOWERS."""
    reflex: bool = False
    """Whether the ego also brakes independently of the plan, near contact."""


@dataclass(frozen=True, slots=True)
class DrivingPlan:
    """The set-points of N skills of M roll-outs."""

    set_point_mps: Floats
    """Shape (N + 1, M): v0, then the speed at the end of each skill; it falls linearly within a skill."""
    lane: tuple[int, ...]
    """The target lane during and after each skill."""


def braking_plan(
    cars: Cars, n_skills: int, t_nom_s: ArrayLike, *, decel_mps2: ArrayLike | None = None, lane_change: bool = False
) -> DrivingPlan:
    """Plan N set-points that each lower the speed by a_p T; a_p = v0 / (N T) by default: to a stop.

    With ``lane_change`` one more skill follows at the last speed; the default of a_p is then half as large, which
    leaves speed for the lane change.
    """
    speed, nominal = np.broadcast_arrays(np.atleast_1d(np.asarray(cars.speed_mps, float)), np.asarray(t_nom_s, float))
    decel = plan_decel(cars, n_skills, nominal, lane_change=lane_change) if decel_mps2 is None else decel_mps2
    steps = np.arange(n_skills + 1.0)[:, np.newaxis]
    points = np.maximum(speed - np.asarray(decel) * nominal * steps, 0.0)
    points[points < 1e-9] = 0.0  # noqa: PLR2004 - rounding at a stop
    if not lane_change:
        return DrivingPlan(points, (0,) * n_skills)
    return DrivingPlan(np.concatenate([points, points[-1:]]), (0,) * n_skills + (1,))


def plan_decel(cars: Cars, n_skills: int, t_nom_s: ArrayLike, *, lane_change: bool = False) -> Floats:
    """Return the default a_p in m/s^2: v0 / (N T), half of it before a lane change."""
    decel: Floats = np.asarray(cars.speed_mps, float) / (n_skills * np.asarray(t_nom_s, float))
    return decel / 2 if lane_change else decel


def start_deadline(cars: Cars, plan_decel_mps2: ArrayLike) -> Floats:
    """Return S_front in s, the latest start of braking at a_p that keeps `SAFETY_M` to the lead.

    If the ego brakes harder than the lead and the speeds meet before the lead stops, the gap is smallest there:
    sqrt(2 (h - d)(a_p - a_l) / (a_l a_p)). Otherwise it is smallest at rest: (h - d) / v0 + v0 / 2 (1/a_l - 1/a_p).
    The lead's jerk, which adds time, and the ego's lag, which takes time, are left out. A negative value means that
    no start keeps the distance.
    """
    distance, lead, speed, plan = np.broadcast_arrays(
        np.maximum(np.asarray(cars.front_gap_m, float) - SAFETY_M, 0.0),
        np.asarray(cars.lead_decel_mps2, float),
        np.asarray(cars.speed_mps, float),
        np.asarray(plan_decel_mps2, float),
    )
    at_rest = distance / speed + speed / 2 * (1 / lead - 1 / plan)
    harder = np.maximum(plan - lead, 0.0)
    meeting = np.sqrt(2 * distance * harder / (lead * plan))
    meets_at = np.divide(plan * meeting, harder, out=np.full(plan.shape, np.inf), where=harder > 0)
    return np.asarray(np.where(meets_at < speed / lead, meeting, at_rest))


def ttc_aware(plans: Plans, deadline_s: ArrayLike) -> tuple[Schedule, NDArray[np.bool_]]:
    """Start at S0 if that keeps the deadline; else at the deadline, if stretching makes that stall-free.

    The paper's future work. Starts from S_lo on are stall-free, so [S_lo, deadline] is feasible, and the deadline
    stretches skills least. If S_lo is past the deadline too, the plan starts with its first skill, each skill is held
    on up to T_max, and the roll-out is late, as the mask says: safety goes before smoothness. All arrivals are known;
    ``deadline_s`` is one number, or of shape (M,).
    """
    arrival_s, nominal_s, most_s = align(plans.arrival_s, plans.nominal_s, plans.most_s)
    deadline = np.broadcast_to(np.asarray(deadline_s, float), arrival_s.shape[1:])
    safe, least = safe_start(arrival_s, nominal_s), safe_start(arrival_s, most_s)
    late = least > deadline
    first = np.where(safe <= deadline, safe, np.where(late, arrival_s[0], deadline))
    start = work_conserving(arrival_s, nominal_s, first)
    # Stretch early skills instead of stalling later: backwards, but not in late plans.
    for i in reversed(range(1, len(start) - 1)):
        np.maximum(start[i], start[i + 1] - most_s[i], out=start[i], where=~late)
    duration = nominal_s.copy()
    np.minimum(np.diff(start, axis=0), most_s[:-1], out=duration[:-1])
    return Schedule(start, duration), late
