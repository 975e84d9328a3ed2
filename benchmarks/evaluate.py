"""Naive, wait-then-act and clairvoyant stream-to-act over millions of plans in one pass, without schedules.

By T1 the three differ only in their start, so a few numbers per plan describe them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.policy import TOLERANCE_S, Floats
from s2a_bench.policy.schedule import align, blocks

Counts: TypeAlias = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """M plans under the three policies at given durations: arrays of shape (M,), times in s from the request."""

    naive_start_s: Floats
    """t_1."""
    safe_start_s: Floats
    """S0, the start of clairvoyant stream-to-act."""
    wait_start_s: Floats
    """t_N."""
    end_s: Floats
    """S0 + P_N, both of naive and of clairvoyant stream-to-act."""
    wait_end_s: Floats
    """t_N + P_N."""
    naive_stalls: Counts
    """Stalls longer than the tolerance."""
    naive_stall_s: Floats
    """Sum of all stalls, S0 - t_1."""
    naive_longest_stall_s: Floats


def evaluate(arrival_s: Floats, duration_s: Floats, tolerance_s: float = TOLERANCE_S) -> Evaluation:
    """Compute every start, end and stall of the three policies from arrivals and durations of shape (N, M), in s."""
    arrival_s, duration_s = align(arrival_s, duration_s)
    first: Floats = arrival_s[0]
    last: Floats = arrival_s[-1]
    safe: Floats = first.copy()
    work: Floats = np.zeros_like(safe)
    longest: Floats = np.zeros_like(safe)
    stalls: Counts = np.zeros(safe.shape, np.int32)
    for part in blocks(safe.size):
        t, d = arrival_s[:, part], duration_s[:, part]
        begin, before, most = safe[part], work[part], longest[part]
        later, stall = np.empty_like(begin), np.empty_like(begin)
        stops = np.empty(begin.shape, np.bool_)
        count = np.zeros(begin.shape, np.uint8)
        for i in range(1, len(t)):
            before += d[i - 1]
            np.subtract(t[i], before, out=later)
            np.maximum(begin, later, out=later)
            np.subtract(later, begin, out=stall)
            np.maximum(most, stall, out=most)
            np.greater(stall, tolerance_s, out=stops)
            count += stops.view(np.uint8)  # bytes: many times faster than adding booleans to integers
            if i % 255 == 0:
                stalls[part] += count
                count[:] = 0
            begin, later = later, begin
        before += d[-1]
        safe[part] = begin
        stalls[part] += count
    return Evaluation(first, safe, last, safe + work, last + work, stalls, safe - first, longest)
