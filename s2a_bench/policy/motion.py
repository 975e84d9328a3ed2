"""How smooth a motion is: jerk, and the spectral arc length SPARC, of a speed profile sampled at a steady rate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


RAMP_S = 0.3
"""How fast a robot's speed follows: the time of one of the two ramps of `speed_profile`."""


def speed_profile(
    start_s: Floats, duration_s: Floats, nominal_s: Floats, sample_s: float, ramp_s: float = RAMP_S
) -> Floats:
    """Return the speed of one timeline, as a share of the planned one, every ``sample_s`` from s_1 on until it rests.

    The arrays have the shape (N,). This is a model, to be named where its numbers are shown: a robot that flows from
    skill to skill moves at T_nom / d while a skill takes d instead of T_nom, and rests while it stalls. Its speed
    follows with limited jerk, by two moving averages over ``ramp_s``: from rest to full speed in 2 ramp_s with a peak
    acceleration of 1 / ramp_s and a jerk of 1 / ramp_s^2.
    """
    edges = np.stack([start_s, start_s + duration_s], axis=1).ravel() - start_s[0]
    way = np.repeat(np.cumsum(nominal_s), 2)
    way[0], way[2::2] = 0.0, way[1:-1:2]
    size = max(round(ramp_s / sample_s), 1)
    cells = int(np.ceil(edges[-1] / sample_s - 1e-9))  # a last cell of rounding alone is none
    at_s = np.arange(cells + 1) * sample_s
    speed = np.diff(np.interp(at_s, edges, way)) / sample_s  # means over the cells: no edge is rounded to a sample
    ramp = np.full(size, 1 / size)
    smooth: Floats = np.convolve(np.convolve(np.pad(speed, 1), ramp), ramp)
    return smooth


def jerk(speed_mps: Floats, sample_s: float) -> Floats:
    """Return the jerk in m/s^3 at the inner samples, by the second central difference: shape (n,) -> (n - 2,)."""
    speed = np.asarray(speed_mps, dtype=np.float64)
    change: Floats = np.diff(speed, 2) / sample_s**2
    return change


def rms_jerk(speed_mps: Floats, sample_s: float) -> float:
    """Return the root of the mean squared jerk in m/s^3; raises ValueError for fewer than 3 samples."""
    return float(np.sqrt(np.mean(_enough(jerk(speed_mps, sample_s)) ** 2)))


def peak_jerk(speed_mps: Floats, sample_s: float) -> float:
    """Return the greatest absolute jerk in m/s^3; raises ValueError for fewer than 3 samples."""
    return float(np.abs(_enough(jerk(speed_mps, sample_s))).max())


def sparc(
    speed_mps: Floats, sample_s: float, *, padding: int = 4, cutoff_hz: float = 10.0, threshold: float = 0.05
) -> float:
    """Return the spectral arc length, without unit: negative, and closer to 0 the smoother the motion.

    The length of the curve of the amplitude spectrum, scaled to its maximum, over frequency, scaled to the band from 0
    to the highest frequency up to ``cutoff_hz`` whose amplitude reaches ``threshold``; the transform is padded to
    2^``padding`` times the next power of two. Definition and defaults: Balasubramanian, Melendez-Calderon,
    Roby-Brami and Burdet, "On the analysis of movement smoothness", J NeuroEng Rehabil 12:112 (2015), which refines
    theirs of 2012 (IEEE TBME 59(8)), and the authors' program. It was made for single movements: compare profiles of
    the same task only. Raises ValueError for a profile that never moves.
    """
    speed = np.asarray(speed_mps, dtype=np.float64)
    if speed.size == 0 or not speed.any():
        raise ValueError("a motion without speed has no smoothness")
    size = 2 ** (int(np.ceil(np.log2(speed.size))) + padding)
    amplitude = np.abs(np.fft.rfft(speed, size))
    frequency_hz = np.fft.rfftfreq(size, sample_s)
    amplitude /= amplitude.max()
    band = frequency_hz <= cutoff_hz
    strong = np.flatnonzero(band & (amplitude >= threshold))
    chosen = slice(strong[0], strong[-1] + 1)
    width_hz = frequency_hz[strong[-1]] - frequency_hz[strong[0]]
    steps = np.diff(frequency_hz[chosen]) / width_hz
    return -float(np.sum(np.hypot(steps, np.diff(amplitude[chosen]))))


def _enough(values: Floats) -> Floats:
    """Raise ValueError for a profile too short to have a jerk."""
    if not values.size:
        raise ValueError("a speed profile needs 3 samples or more to have a jerk")
    return values
