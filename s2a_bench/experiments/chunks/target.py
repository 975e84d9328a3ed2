"""Where the robot should be, which nobody can know far ahead, and its best forecast: what a policy can do at best.

Virtual time has no pictures and no policy. A stand-in that cannot be improved leaves timing alone to be measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Ints

RATE: Final = 3.0
"""In 1/s: how fast the target changes its mind. What it does in .32 s is known up to .66 standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A target at control ticks, in units of its standard deviation; arrays of shape (K,).

    Position x and drift y = x' + r x follow dy = -r y dt + noise, dx = (y - r x) dt: a stationary Gaussian process with
    covariance (1 + r |t|) e^(-r |t|), Matern's with parameter 3/2. Its path has a velocity, and no acceleration.
    """

    position: Floats
    drift: Floats
    period_s: float

    def forecast(self, tick: Ints, ahead: Ints) -> Floats:
        """Return E[x(tick + ahead)] given all until ``tick``, arrays of one shape; with ``ahead`` >= 0."""
        time_s = ahead * self.period_s
        expected: Floats = np.exp(-RATE * time_s) * (self.position[tick] + self.drift[tick] * time_s)
        return expected


def draw_target(rng: np.random.Generator, ticks: int, period_s: float) -> Target:
    """Draw a target, exact at its ticks; the first ones are the same however many there are."""
    from scipy.signal import lfilter
    from scipy.special import gammainc

    step = RATE * period_s
    keep = np.exp(-step)
    of_drift, of_both, of_position = gammainc((1, 2, 3), 2 * step)  # what noise adds in a tick to x and y / r
    added = np.linalg.cholesky([[2 * of_drift, of_both], [of_both, of_position]])
    first = np.linalg.cholesky([[2.0, 1.0], [1.0, 1.0]])
    drawn = rng.standard_normal((ticks, 2))
    noise = drawn @ added.T
    noise[:1] = drawn[:1] @ first.T
    drift = lfilter([1.0], [1.0, -keep], noise[:, 0])
    noise[1:, 1] += keep * step * drift[:-1]
    return Target(lfilter([1.0], [1.0, -keep], noise[:, 1]), RATE * drift, period_s)
