"""The check on the car behind: does it stop behind an ego that never stalls? Else its rear outcomes say nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.policy import Schedule
from s2a_bench.scenario.ccrb.cars import LEAST_IMPACT_MPS, Cars, DrivingPlan
from s2a_bench.scenario.ccrb.drive import drive
from s2a_bench.scenario.longitudinal import Longitudinal

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

NOBODY_M: Final = 1e6
"""With the lead so far away nothing but the plan slows the ego down."""


def follower_survives(cars: Cars, plan: DrivingPlan, n_skills: ArrayLike, t_nom_s: ArrayLike) -> NDArray[np.bool_]:
    """Return whether the trailing car never hits an ego whose tokens come at once, at the same gap; shape (M,).

    Skill follows skill, each as long as planned, with nobody ahead; a plan shorter than the longest ends earlier.
    """
    count, nominal_s = np.broadcast_arrays(np.atleast_1d(n_skills), np.atleast_1d(np.asarray(t_nom_s, float)))
    place = np.arange(count.max())[:, np.newaxis]
    schedule = Schedule(np.minimum(place, count) * nominal_s, np.where(place < count, nominal_s, 0.0))
    alone = replace(cars, front_gap_m=NOBODY_M, onset_s=0.0, reflex=False)
    along = DrivingPlan(plan.set_point_mps, (0,) * len(plan.lane))
    found = drive(Longitudinal(), alone, along, schedule, resting_mps=LEAST_IMPACT_MPS).outcomes
    safe: NDArray[np.bool_] = found.code & 2 == 0
    return safe
