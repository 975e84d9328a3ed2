"""Straight lines through measurements: a fixed cost and a cost per unit, with intervals.

A line minimises the *relative* distances of the points, so small and large pictures count equally. A point is the
geometric mean of the launches of one x. Its distance from the line holds how launches vary and how far the cost is from
a line, so the intervals, Student's t of the distances, hold both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its 95 % interval; None if two points leave no distances."""

    value: float
    ci95: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Line:
    """``y = fixed + slope x``; ``off`` is the root mean square of its distances from the points, as shares of them.

    ``spread`` is half of a point's 95 % interval around the true line, as a share of it, and ``covariance`` what it
    adds for the line's own, both with Student's t; None for two points.
    """

    fixed: Estimate
    slope: Estimate
    off: float
    spread: float | None = None
    covariance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The covariances of fixed and fixed, fixed and slope, slope and slope."""

    def at(self, x: float) -> float:
        return self.fixed.value + self.slope.value * x

    def reach(self, x: float) -> float | None:
        """Return half of the 95 % interval of a new point at ``x``; None for a line of two points."""
        if self.spread is None:
            return None
        first, both, second = self.covariance
        return self.spread * math.sqrt(self.at(x) ** 2 + first + 2 * both * x + second * x * x)


def fit_line(launches: Iterable[tuple[float, float]]) -> Line | None:
    """Fit a line through (x, y above 0) of launches; None for fewer than two different x."""
    from scipy import special

    at: dict[float, list[float]] = {}
    for x, y in launches:
        at.setdefault(x, []).append(y)
    freedom = len(at) - 2
    if freedom < 0:
        return None
    points = np.exp([np.mean(np.log(ys)) for ys in at.values()])
    design = np.stack([np.ones_like(points), np.array([*at])], 1) / points[:, None]
    covariance = np.linalg.inv(design.T @ design)
    values = covariance @ design.sum(0)
    squares = float(np.sum(np.square(design @ values - 1)))

    def estimate(place: int) -> Estimate:
        value = float(values[place])
        if not freedom:
            return Estimate(value, None)
        reach = float(special.stdtrit(freedom, 0.975) * np.sqrt(covariance[place, place] * squares / freedom))
        return Estimate(value, (value - reach, value + reach))

    spread = float(special.stdtrit(freedom, 0.975) * np.sqrt(squares / freedom)) if freedom else None
    of = (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]))
    return Line(estimate(0), estimate(1), float(np.sqrt(squares / len(points))), spread, of)
