"""Naive, wait-then-act and clairvoyant stream-to-act over millions of plans in one pass, and where naive never stalls.

By T1 the three differ only in their start, so a few numbers per plan describe them. Naive is stall-free iff S0 = t_1;
at steady rate and equal durations T that is L / R <= T, the paper's figure 2 over tokens per skill L and rate R. The
paper draws that line for T_min, but naive runs skills at T_nom: figures show both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.boards.gaps import Gaps
from s2a_bench.policy import TOLERANCE_S, Floats
from s2a_bench.policy.arrivals import fragments, tokens
from s2a_bench.policy.schedule import align, blocks

Counts: TypeAlias = NDArray[np.int32]
Flags: TypeAlias = NDArray[np.bool_]


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


@dataclass(frozen=True, slots=True)
class Grid:
    """Axes of the analytic and the simulated region: L (K,) by R (J,)."""

    tokens_per_skill: tuple[int, ...]
    tokens_per_s: tuple[float, ...]


def analytic(grid: Grid, duration_s: float) -> Flags:
    """Return where steady arrivals are stall-free, shape (K, J): L / R <= T."""
    slowest = np.array(grid.tokens_per_skill, dtype=np.float64) / duration_s
    return np.less_equal.outer(slowest, np.array(grid.tokens_per_s, dtype=np.float64))


def simulate(
    grid: Grid,
    gaps: Gaps,
    *,
    n_skills: int,
    duration_s: float,
    plans: int,
    rng: np.random.Generator,
    tolerance_s: float = TOLERANCE_S,
) -> Floats:
    """Return P(a naive plan stalls), shape (K, J), over random plans: a share, with sd <= 0.5 / sqrt(plans).

    ``gaps`` gives the shape of the jitter; its gaps are scaled to each rate. One set of draws serves the whole grid, so
    neighbouring cells do not differ by chance. The prompt's time shifts all arrivals equally and is left out.
    """
    longest = max(grid.tokens_per_skill)
    at = tokens(gaps, 0.0, longest * n_skills, plans, rng) / gaps.mean_s
    share = np.empty((len(grid.tokens_per_skill), len(grid.tokens_per_s)))
    for row, per_skill in enumerate(grid.tokens_per_skill):
        unit = fragments(at[: per_skill * n_skills], per_skill)
        for column, rate in enumerate(grid.tokens_per_s):
            stalls = evaluate(unit / rate, np.full((n_skills, 1), duration_s), tolerance_s).naive_stalls
            share[row, column] = np.count_nonzero(stalls) / plans
    return share
