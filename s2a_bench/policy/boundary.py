"""Where naive execution needs no help: the stall-free region over tokens per skill L and rate R (the paper's figure 2).

A plan is stall-free under naive iff S0 = t_1, that is, no fragment is later than the work before it allows. At steady
rate and equal durations T that is L / R <= T. The paper draws the line for T_min, but naive runs skills at T_nom: both
lines are worth drawing. Durations are in s, rates in tokens/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from s2a_bench.policy.arrivals import fragments, tokens
from s2a_bench.policy.evaluate import TOLERANCE_S, evaluate

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from s2a_bench.boards.gaps import Gaps
    from s2a_bench.policy import Floats

    Flags: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Grid:
    """The same axes for the analytic and the simulated region: L down (K,), R across (J,)."""

    tokens_per_skill: tuple[int, ...]
    tokens_per_s: tuple[float, ...]


def slowest_rate(tokens_per_skill: ArrayLike, duration_s: float) -> Floats:
    """Return the line R = L / T, in tokens/s: naive is stall-free at this rate and above."""
    return np.asarray(tokens_per_skill, dtype=np.float64) / duration_s


def analytic(grid: Grid, duration_s: float) -> Flags:
    """Return where steady arrivals are stall-free, shape (K, J): L / R <= T."""
    rates: Floats = np.array(grid.tokens_per_s, dtype=np.float64)
    return slowest_rate(grid.tokens_per_skill, duration_s)[:, np.newaxis] <= rates


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
    neighbouring cells differ by what they are, not by luck. The prompt's time shifts every arrival alike and so has no
    part in it.
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


def naive_is_stall_free(arrival_s: Floats, duration_s: Floats, tolerance_s: float = 1e-9) -> Flags:
    """Say for each of M plans whether naive runs it without a stall: S0 = t_1, within rounding."""
    found = evaluate(arrival_s, duration_s)
    free: Flags = found.naive_stall_s <= tolerance_s
    return free
