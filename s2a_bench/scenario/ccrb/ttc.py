"""The start before a deadline set by the car ahead (the paper's future work), from closed forms."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.schedule import align, safe_start, work_conserving

NAME: Final = "s2a-ttc"


def ttc_aware(plans: Plans, deadline_s: ArrayLike) -> tuple[Schedule, NDArray[np.bool_]]:
    """Start at S0 if that keeps the deadline; else at the deadline, if stretching makes that stall-free.

    Starts from S_lo on are stall-free, so [S_lo, deadline] is feasible, and the deadline stretches skills least. If
    S_lo is past the deadline too, the plan starts with its first skill, each skill is held on up to T_max, and the
    roll-out is late, as the mask says: safety goes before smoothness. All arrivals are known; ``deadline_s`` is one
    number, or of shape (M,).
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
