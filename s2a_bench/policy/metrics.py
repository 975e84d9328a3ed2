"""Metrics of a timeline: waiting, stalls, regret, age of actions, distortion, fluidity, smoothness.

Arrays have the shape (N, M) per skill and (M,) per plan; times are in s from the request. An undefined value, such as a
regret over a span of length zero, is NaN, never zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from s2a_bench.policy import TOLERANCE_S, Floats, Plans, Schedule
from s2a_bench.policy.schedule import align, least_end, safe_start

RAMP_S = 0.3
"""Duration of each of the two ramps of `speed_profile`."""


@dataclass(frozen=True, slots=True)
class PlanMetrics:
    """M timelines of one policy: arrays of shape (M,)."""

    first_action_s: Floats
    """Time to first action, s_1."""
    end_s: Floats
    """Completion, e_N."""
    stalls: NDArray[np.int32]
    """Number of stalls longer than the tolerance (stop-and-go)."""
    stall_s: Floats
    """Sum of all stalls of any length."""
    longest_stall_s: Floats
    stall_ratio: Floats
    """Share of the time from first action to completion that is stalled."""
    start_regret: Floats
    """max(0, s_1 - S0) / S0."""
    signed_start_regret: Floats
    """(s_1 - S0) / S0: negative for a start before S0, which stretching can make safe."""
    start_regret_elastic: Floats
    """max(0, s_1 - S_lo) / S_lo, over the least start that stretching to T_max allows (T2)."""
    too_early_s: Floats
    """max(0, S_lo - s_1): the stall that no stretching can avoid after this start."""
    start_regret_of_wait: Floats
    """max(0, s_1 - S0) / (t_N - S0): 0 for clairvoyant, 1 for wait-then-act. Unlike the regret over S0, it does not
    shrink with a long time to first token."""
    end_regret: Floats
    """(e_N - E) / E with E = S0 + P_N, the end of clairvoyant stream-to-act and of naive."""
    end_regret_of_wait: Floats
    """(e_N - E) / (t_N - S0): 1 for wait-then-act."""
    end_regret_elastic: Floats
    """(e_N - E_lo) / E_lo, over the least end that T_min allows."""
    mean_queue_wait_s: Floats
    """Mean of s_i - t_i."""
    longest_queue_wait_s: Floats
    mean_action_age_s: Floats
    """Mean of s_i - t_observation, the age of the picture behind each action."""
    oldest_action_s: Floats
    speed_distortion: Floats
    """Sum of durations, holding included, over the sum of nominal durations: above 1 is slower than planned."""
    fluidity: Floats
    """Share of deadlines met; see `fluidity`."""


def measure(plans: Plans, schedule: Schedule, *, tolerance_s: float = TOLERANCE_S) -> PlanMetrics:
    """Compute the metrics of M timelines; stalls above ``tolerance_s`` count. A picture is as old as its request."""
    arrival_s, nominal_s, least_s, most_s, start_s, duration_s = align(
        plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s, schedule.start_s, schedule.duration_s
    )
    first, end = start_s[0], start_s[-1] + duration_s[-1]
    safe = safe_start(arrival_s, nominal_s)
    best_end = safe + nominal_s.sum(axis=0)
    elastic_end = least_end(arrival_s, least_s)
    stalls_s = stalls(schedule)
    stall_s = stalls_s.sum(axis=0)
    waits = start_s - arrival_s
    least = safe_start(arrival_s, most_s)
    late = np.maximum(first - safe, 0.0)
    span = arrival_s[-1] - safe
    return PlanMetrics(
        first_action_s=first,
        end_s=end,
        stalls=np.sum(stalls_s > tolerance_s, axis=0, dtype=np.int32),
        stall_s=stall_s,
        longest_stall_s=stalls_s.max(axis=0, initial=0.0),
        stall_ratio=_share(stall_s, end - first),
        start_regret=_share(late, safe),
        signed_start_regret=_share(first - safe, safe),
        start_regret_elastic=_share(np.maximum(first - least, 0.0), least),
        too_early_s=np.maximum(least - first, 0.0),
        start_regret_of_wait=_share(late, span),
        end_regret=_share(end - best_end, best_end),
        end_regret_of_wait=_share(end - best_end, span),
        end_regret_elastic=_share(end - elastic_end, elastic_end),
        mean_queue_wait_s=waits.mean(axis=0),
        longest_queue_wait_s=waits.max(axis=0),
        mean_action_age_s=start_s.mean(axis=0),
        oldest_action_s=start_s.max(axis=0),
        speed_distortion=_share(duration_s.sum(axis=0), nominal_s.sum(axis=0)),
        fluidity=fluidity(stalls_s, nominal_s, tolerance_s),
    )


def stalls(schedule: Schedule) -> Floats:
    """Return max(0, s_{i+1} - e_i) for i = 1..N-1, shape (N - 1, M): waiting before skill 1 is no stall."""
    start_s, duration_s = align(schedule.start_s, schedule.duration_s)
    stall_s: Floats = start_s[1:] - start_s[:-1]
    stall_s -= duration_s[:-1]
    return np.maximum(stall_s, 0.0, out=stall_s)


def fluidity(stalls_s: Floats, nominal_s: Floats, tolerance_s: float = TOLERANCE_S) -> Floats:
    """Return the fluidity index, shape (M,): 1 - missed deadlines / all deadlines (Etalon, arXiv 2407.07000).

    Etalon gives each token a deadline, carries the slack of early tokens over, and after a late one counts every
    deadline missed meanwhile, floor(lateness / D_d) + 1, before it starts anew. Here a token is a skill. Its deadline
    is the end of the skill before: D_d is that skill's nominal duration, the slack is the queue, and the lateness is
    the stall. The first deadline (Etalon's D_p) is the policy's start and always met, so a late start costs nothing:
    read it beside the time to first action.
    """
    stalls_s, budget_s = align(stalls_s, nominal_s[:-1])
    late = stalls_s > tolerance_s
    missed = np.where(late, np.floor(_share(stalls_s, budget_s)) + 1, 0.0).sum(axis=0)
    met = 1 + np.sum(~late, axis=0)
    return np.asarray(met / (met + missed))


def speed_profile(start_s: Floats, duration_s: Floats, nominal_s: Floats, sample_s: float) -> Floats:
    """Return the speed of one timeline, over the planned speed, every ``sample_s`` from s_1 until the robot rests.

    The arrays have the shape (N,). This is a model, and reports name it: the robot moves at T_nom / d while a skill
    takes d instead of T_nom, without a pause between skills, and rests while it stalls. Two moving averages over
    `RAMP_S` limit the jerk: from rest to full speed in 2 RAMP_S with a peak acceleration of 1 / RAMP_S and a jerk of
    1 / RAMP_S^2.
    """
    edges = np.stack([start_s, start_s + duration_s], axis=1).ravel() - start_s[0]
    way = np.repeat(np.cumsum(nominal_s), 2)
    way[0], way[2::2] = 0.0, way[1:-1:2]
    size = max(round(RAMP_S / sample_s), 1)
    cells = int(np.ceil(edges[-1] / sample_s - 1e-9))  # no last cell from rounding alone
    at_s = np.arange(cells + 1) * sample_s
    speed = np.diff(np.interp(at_s, edges, way)) / sample_s  # cell means: edges are not rounded to samples
    ramp = np.full(size, 1 / size)
    return np.convolve(np.convolve(np.pad(speed, 1), ramp), ramp)


def jerk(speed_mps: Floats, sample_s: float) -> Floats:
    """Return the jerk in m/s^3 by second central differences: shape (n,) -> (n - 2,); raises ValueError for n < 3."""
    if len(speed_mps) < 3:  # noqa: PLR2004 - a second difference
        raise ValueError("a speed profile needs 3 samples or more to have a jerk")
    return np.diff(np.asarray(speed_mps, dtype=np.float64), 2) / sample_s**2


def motion(speed_mps: Floats, sample_s: float) -> dict[str, float]:
    """Return jerk and smoothness of a speed profile by the columns of rows."""
    jerks = jerk(speed_mps, sample_s)
    return {
        "rms_jerk": float(np.sqrt(np.mean(jerks**2))),
        "peak_jerk": float(np.abs(jerks).max()),
        "sparc": sparc(speed_mps, sample_s),
    }


def sparc(
    speed_mps: Floats, sample_s: float, *, padding: int = 4, cutoff_hz: float = 10.0, threshold: float = 0.05
) -> float:
    """Return the spectral arc length, without unit: negative, and closer to 0 the smoother the motion.

    The length of the curve of the amplitude spectrum, scaled to its maximum, over frequency, scaled to the band from 0
    to the highest frequency up to ``cutoff_hz`` whose amplitude reaches ``threshold``; the transform is padded to
    2^``padding`` times the next power of two. Definition and defaults: Balasubramanian, Melendez-Calderon,
    Roby-Brami and Burdet, "On the analysis of movement smoothness", J NeuroEng Rehabil 12:112 (2015), and the authors'
    program. It is defined for single movements: compare profiles of the same task only. Raises ValueError for a profile
    that never moves.
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


def _share(part: Floats, whole: Floats) -> Floats:
    return np.asarray(np.divide(part, whole, out=np.full(part.shape, np.nan), where=whole > 0))
