"""How smoothly a plant moved, and how well it followed, in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Ints
    from s2a_bench.robots.plant import Motion


@dataclass(frozen=True, slots=True)
class Smoothness:
    """One run; NaN where there is nothing to count. Root mean squares are over joints and time, u the actions' unit."""

    tracking_rms: float
    """Of position minus reference when ticks begin, in u; NaN without a reference."""
    jerk_rms: float
    """In u/s^3."""
    acceleration_max: float
    """The greatest of any joint, in u/s^2."""
    boundary_jump_mean: float
    """|a_new - a_old|, from the last action of a chunk to the first of the next one; Euclidean over joints, in u."""
    boundary_jump_p99: float
    boundary_jump_max: float
    action_step_mean: float
    """The same from one action to the next within a chunk: what is usual."""


def smoothness(motion: Motion, actions: Floats, chunk: Ints, reference: Floats | None = None) -> Smoothness:
    """Measure a motion under actions of shape (K, D), of which tick k's is from ``chunk[k]``, -1 in a stall.

    ``reference``, shape (K, D), is where the joints should have been when each tick began.
    """
    error = None if reference is None else motion.position[:, 0] - reference
    acted = np.flatnonzero(chunk >= 0)
    step = np.linalg.norm(np.diff(actions[acted], axis=0), axis=1)
    other = np.diff(chunk[acted]) != 0
    jump = step[other]
    return Smoothness(
        tracking_rms=nan if error is None else _rms(error),
        jerk_rms=_rms(motion.jerk),
        acceleration_max=float(np.abs(motion.acceleration).max()),
        boundary_jump_mean=_mean(jump),
        boundary_jump_p99=float(np.quantile(jump, 0.99)) if jump.size else nan,
        boundary_jump_max=float(jump.max()) if jump.size else nan,
        action_step_mean=_mean(step[~other]),
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else nan
