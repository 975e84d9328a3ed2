"""The scenario: car-to-car rear braking (Euro NCAP CCRb) with a car behind; roles, numbers, plan and deadline.

Euro NCAP's test protocol for AEB car-to-car: both cars at 50 km/h, 12 or 40 m apart, and the lead brakes at 2 or
6 m/s^2. The trailing car is the paper's (section V-F). No simulator in here: `drive` puts these cars into one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from s2a_bench.plan.skillset import Gap
from s2a_bench.policy import Floats

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

KMH: Final = 1 / 3.6
NCAP_SPEED_MPS: Final = 50 * KMH
NCAP_GAPS_M: Final = (12.0, 40.0)
NCAP_DECELS_MPS2: Final = (2.0, 6.0)
LEAD_JERK_MPS3: Final = 6.0
"""How fast the lead's braking builds up."""
EGO_MOST_MPS2, EGO_LEAST_MPS2 = 2.0, -8.0
"""What the ego can do."""
EGO_LOOP_S: Final = 0.3
"""Time constant of the ego's speed control."""
LEAST_IMPACT_MPS: Final = 0.5
"""Slower contacts do not count."""
SAFETY_M: Final = 2.0
"""What the start deadline leaves to the lead."""
CAR_WIDTH_M: Final = 2.0
OUTCOMES: Final = ("none", "front", "rear", "both")
"""By code: bit 0 is a front impact, bit 1 a rear impact."""


@dataclass(frozen=True, slots=True)
class Cars:
    """One scenario, or M of them where numbers are arrays of shape (M,)."""

    front_gap_m: ArrayLike = 40.0
    lead_decel_mps2: ArrayLike = 2.0
    rear_gap_m: ArrayLike = 14.0
    reaction_s: ArrayLike = 1.3
    """The trailing car acts on what it saw this long ago."""
    speed_mps: ArrayLike = NCAP_SPEED_MPS
    """v0 of all three."""
    gap: Gap | NDArray[np.str_] = "stop"
    """What the ego does between skills, while none is valid; one name, or an array of them."""
    follower: str = "careful"
    """The trailing car's law, a name of FOLLOWERS."""
    gap_decel_mps2: ArrayLike = 8.0
    """How hard the gap behaviour *stop* brakes."""
    ego_jerk_mps3: ArrayLike = 30.0
    """How fast the ego's acceleration changes at most."""
    build_s: ArrayLike = 0.6
    """How long the trailing car's full brake force takes to build up."""
    onset_s: ArrayLike = 0.0
    """When the lead begins to brake, counted from the request; until then all drive at v0."""
    reflex: bool = False
    """Whether the ego brakes by itself where the plan would not: `ego.Reflex`."""


@dataclass(frozen=True, slots=True)
class DrivingPlan:
    """N skills of M roll-outs as what a controller follows: speed set-points, and lanes."""

    set_point_mps: Floats
    """Shape (N + 1, M): v0, then the speed at the end of each skill; in between it falls evenly."""
    lane: tuple[int, ...]
    """The lane steered for during and after each skill."""


def braking_plan(
    cars: Cars, n_skills: int, t_nom_s: ArrayLike, *, decel_mps2: ArrayLike | None = None, lane_change: bool = False
) -> DrivingPlan:
    """Plan N set-points that each lower the speed by a_p T; a_p = v0 / (N T) unless given: to a stop.

    With ``lane_change`` one more skill follows, which keeps the last speed; then a_p is half of that unless given, so
    that there is speed left to change lanes with.
    """
    import numpy as np

    speed, nominal = np.broadcast_arrays(np.atleast_1d(np.asarray(cars.speed_mps, float)), np.asarray(t_nom_s, float))
    decel = plan_decel(cars, n_skills, nominal, lane_change=lane_change) if decel_mps2 is None else decel_mps2
    steps = np.arange(n_skills + 1.0)[:, np.newaxis]
    points = np.maximum(speed - np.asarray(decel) * nominal * steps, 0.0)
    points[points < 1e-9] = 0.0  # noqa: PLR2004 - rounding, where the plan stops
    if not lane_change:
        return DrivingPlan(points, (0,) * n_skills)
    return DrivingPlan(np.concatenate([points, points[-1:]]), (0,) * n_skills + (1,))


def plan_decel(cars: Cars, n_skills: int, t_nom_s: ArrayLike, *, lane_change: bool = False) -> Floats:
    """Return a_p in m/s^2 unless a plan is given another one: v0 / (N T), half of it before a lane change."""
    import numpy as np

    decel: Floats = np.asarray(cars.speed_mps, float) / (n_skills * np.asarray(t_nom_s, float))
    return decel / 2 if lane_change else decel


def start_deadline(cars: Cars, plan_decel_mps2: ArrayLike) -> Floats:
    """Return S_front in s: who starts to brake at a_p by then keeps `SAFETY_M` to the lead (POLICY section 6).

    Where the ego brakes harder than the lead and the speeds meet before the lead stops, the gap is smallest there:
    sqrt(2 (h - d)(a_p - a_l) / (a_l a_p)). Otherwise it is smallest at rest: (h - d) / v0 + v0 / 2 (1/a_l - 1/a_p).
    The lead's jerk (which gives time) and the ego's lag (which takes it) are left out. Negative: too late from the
    beginning.
    """
    import numpy as np

    room, lead, speed, own = np.broadcast_arrays(
        np.maximum(np.asarray(cars.front_gap_m, float) - SAFETY_M, 0.0),
        np.asarray(cars.lead_decel_mps2, float),
        np.asarray(cars.speed_mps, float),
        np.asarray(plan_decel_mps2, float),
    )
    at_rest = room / speed + speed / 2 * (1 / lead - 1 / own)
    harder = np.maximum(own - lead, 0.0)
    meeting = np.sqrt(2 * room * harder / (lead * own))
    meets_at = np.divide(own * meeting, harder, out=np.full(own.shape, np.inf), where=harder > 0)
    return np.asarray(np.where(meets_at < speed / lead, meeting, at_rest))
