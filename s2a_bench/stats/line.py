"""Straight lines through groups of measurements, a fixed cost and a cost per unit, with intervals and crossings.

A line minimises the *relative* distances of the groups' medians from it, so small and large pictures count equally.
Intervals are percentiles of a bootstrap of two stages (Davison and Hinkley, Bootstrap Methods, 3.8): groups of the same
x, which are launches, are drawn with replacement, and so are the values within each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from s2a_bench.stats.batches import Floats

DRAWS: Final = 1000
SURE: Final = 0.95
LIMITS: Final = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Line:
    """``y = fixed + slope x``.

    ``off`` is the root mean square of the medians' distances from the line, as shares of it. ``draws`` are
    (fixed, slope) of the bootstrap: float64 (draws, 2).
    """

    fixed: Estimate
    slope: Estimate
    off: float
    draws: Floats

    def at(self, x: float) -> float:
        return self.fixed.value + self.slope.value * x


def fit_line(groups: Sequence[tuple[float, Floats]], seed: int = 0) -> Line | None:
    """Fit a line through groups of (x, values of y above 0); None for fewer than two different x."""
    groups = [(x, values) for x, values in groups if values.size]
    x = np.array([x for x, _ in groups])
    if len(set(x.tolist())) < 2:  # noqa: PLR2004 - a line needs two
        return None
    rng = np.random.default_rng(seed)
    y = np.array([np.median(values) for _, values in groups])
    picks = [rng.integers(values.size, size=(DRAWS, values.size)) for _, values in groups]
    within = np.stack([np.median(values[pick], 1) for (_, values), pick in zip(groups, picks, strict=True)])
    drawn = np.empty_like(within)
    for size in set(x.tolist()):
        launches = np.flatnonzero(x == size)
        which = launches[rng.integers(launches.size, size=(launches.size, DRAWS))]
        drawn[launches] = within[which, rng.integers(DRAWS, size=which.shape)]
    fixed, slope = _fit(x, y[:, None])
    draws = np.stack(_fit(x, drawn), 1)
    off = float(np.sqrt(np.mean(np.square(y / (fixed[0] + slope[0] * x) - 1))))
    (low, low_slope), (high, high_slope) = np.percentile(draws, LIMITS, 0)
    return Line(
        Estimate(float(fixed[0]), float(low), float(high)),
        Estimate(float(slope[0]), float(low_slope), float(high_slope)),
        off,
        draws,
    )


def crossing(one: Line, other: Line) -> Estimate | None:
    """Return the x above 0 at which two lines cross; None if they do not, or fewer than 95 % of the draws do."""
    best = [[one.fixed.value - other.fixed.value, one.slope.value - other.slope.value]]
    fixed, slope = np.vstack([best, one.draws - other.draws]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        met = np.where(slope == 0, -1.0, -fixed / slope)
    point, met = met[0].item(), met[1:]
    same_way = np.sign(slope[1:]) == np.sign(slope[0])
    if point <= 0 or np.mean((met > 0) & same_way) < SURE:
        return None
    low, high = np.percentile(met[(met > 0) & same_way], LIMITS)
    return Estimate(point, float(low), float(high))


def _fit(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Fit y (groups, fits) with weights 1 / y^2; return fixed and slope, each (fits,)."""
    x, weights = x[:, None], 1 / np.square(y)
    total, first, second = (np.sum(weights * x**power, 0) for power in range(3))
    sum_y, sum_xy = np.sum(weights * y, 0), np.sum(weights * x * y, 0)
    scale = total * second - first**2
    return (second * sum_y - first * sum_xy) / scale, (total * sum_xy - first * sum_y) / scale
