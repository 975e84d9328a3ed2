"""Closed forms: when each skill starts under a rule that knows all arrivals, for M plans of N skills at once.

Arrays have the shape (N, M), one row a skill, so every pass runs along contiguous plans. Arrivals and durations
broadcast: a column (N, 1) stands for all plans. Times are in seconds from the request, in float64. The passes work in
place on 16 thousand plans at a time, which stay in the cache.

With t_i the arrival of fragment i, and P_i, M_i, Q_i the sums of the nominal, least and most durations up to skill i
(P_0 = 0), the paper's start time is S0 = max_i (t_i - P_{i-1}) (section IV-F, there for one constant T_nom).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from s2a_bench.policy import Floats, Plans, Schedule

BLOCK = 16_384
"""Plans per pass: a row is 128 KiB, and the few rows in use fit a core's L2 cache."""


def blocks(plans: int) -> Iterator[slice]:
    """Yield the column slices of `BLOCK` plans each that cover ``plans`` columns."""
    for first in range(0, plans, BLOCK):
        yield slice(first, min(first + BLOCK, plans))


def align(*arrays: ArrayLike) -> tuple[Floats, ...]:
    """Broadcast arrays against one another as float64 of shape (N, M); the results are read-only views."""
    return np.broadcast_arrays(*(np.asarray(array, dtype=np.float64) for array in arrays))


def safe_start(arrival_s: Floats, duration_s: Floats) -> Floats:
    """Return max_i (t_i - D_{i-1}), shape (M,): the least start from which running at ``duration_s`` never stalls.

    With nominal durations this is S0, with the longest S_lo, the least start when skills may be stretched (T2), and
    with the shortest the start that stays safe when skills may finish early (T5).
    """
    arrival_s, duration_s = align(arrival_s, duration_s)
    start: Floats = arrival_s[0].copy()
    for part in blocks(start.size):
        latest, t, d = start[part], arrival_s[:, part], duration_s[:, part]
        before = np.zeros_like(latest)
        slack = np.empty_like(latest)
        for i in range(1, len(t)):
            before += d[i - 1]
            np.subtract(t[i], before, out=slack)
            np.maximum(latest, slack, out=latest)
    return start


def least_end(arrival_s: Floats, least_s: Floats) -> Floats:
    """Return E_lo = max_i (t_i + M_N - M_{i-1}), shape (M,): no schedule ends earlier (T2)."""
    arrival_s, least_s = align(arrival_s, least_s)
    return np.asarray(safe_start(arrival_s, least_s) + least_s.sum(axis=0))


def work_conserving(arrival_s: Floats, duration_s: Floats, first_s: ArrayLike) -> Floats:
    """Return the starts, shape (N, M), of an executor that begins at ``first_s`` and idles only for missing skills.

    s_1 = max(first_s, t_1) and s_i = max(t_i, s_{i-1} + d_{i-1}). Started at S it stalls for max(0, S0 - S) in all and
    ends at max(S, S0) + P_N (T1): naive is S = t_1, wait-then-act S = t_N, clairvoyant stream-to-act S = S0.
    """
    arrival_s, duration_s = align(arrival_s, duration_s)
    start: Floats = np.empty(arrival_s.shape)
    np.maximum(first_s, arrival_s[0], out=start[0])
    for part in blocks(start.shape[1]):
        s, t, d = start[:, part], arrival_s[:, part], duration_s[:, part]
        for i in range(1, len(s)):
            np.add(s[i - 1], d[i - 1], out=s[i])
            np.maximum(s[i], t[i], out=s[i])
    return start


def hold(arrival_s: Floats, start_s: Floats, duration_s: Floats, latest_s: Floats) -> Floats:
    """Return the duration of each skill, shape (N, M), held on until the next arrives, as `Start` defines.

    A skill of ``duration_s`` runs until the next has arrived, at most for ``latest_s``; the last is not held. Holding
    does not change a work-conserving schedule's starts: it turns stalls into slow motion.
    """
    arrival_s, start_s, duration_s, latest_s = align(arrival_s, start_s, duration_s, latest_s)
    held: Floats = np.empty(arrival_s.shape)
    held[-1] = duration_s[-1]
    np.subtract(arrival_s[1:], start_s[:-1], out=held[:-1])
    np.maximum(held[:-1], duration_s[:-1], out=held[:-1])
    np.minimum(held[:-1], latest_s[:-1], out=held[:-1])
    return held


def elastic(plans: Plans) -> Schedule:
    """Return the componentwise least schedule without stalls when each skill may take its least to most time (T2).

    Forward l_i = max(t_i, l_{i-1} + T_min,i-1), backward s_i = max(l_i, s_{i+1} - T_max,i), in O(N). It attains the
    least start S_lo and the least end E_lo at once; knowing all arrivals, it stretches early skills before it must.
    """
    arrival_s, least_s, most_s = align(plans.arrival_s, plans.least_s, plans.most_s)
    start = work_conserving(arrival_s, least_s, arrival_s[0])
    duration = np.empty_like(start)
    duration[-1] = least_s[-1]
    for part in blocks(start.shape[1]):
        s, most, d = start[:, part], most_s[:, part], duration[:, part]
        for i in reversed(range(len(s) - 1)):
            np.subtract(s[i + 1], most[i], out=d[i])
            np.maximum(s[i], d[i], out=s[i])
            np.subtract(s[i + 1], s[i], out=d[i])
    return Schedule(start, duration)
