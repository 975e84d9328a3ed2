"""Uncertainty of one launch's statistics: the launch is cut into batches of time, which are resampled."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.stats import Floats

Rows: TypeAlias = Sequence[Floats]
"""The values of one launch in order of time: one array per request (its value, or the gaps of its tokens)."""

STATISTICS: Final[Mapping[str, float | None]] = {"median": 0.5, "mean": None, "p90": 0.9, "p99": 0.99}
"""Statistic -> quantile; None for the mean."""

BATCHES: Final = 10
"""Batches per launch; 10 to 30 are enough for an interval (Schmeiser 1982)."""

FEWEST_ROWS: Final = 5
"""Fewer requests have no interval."""

FEWEST_BEYOND: Final = 5
"""A percentile has an interval if at least this many values lie beyond it: p90 needs 50 values, p99 500."""

CHANCE: Final = 2.0
"""Greatest correlation by chance, in standard deviations of about 1 / sqrt(n) of independent neighbours."""

_RESAMPLES: Final = 1000
_ROUNDING: Final = 1e-9


@final
class LaunchValues:
    """The values of one launch in up to `BATCHES` batches of rows, none empty; percentiles are found by sorted rank."""

    def __init__(self, rows: Rows) -> None:
        self.n_rows = len(rows)
        self.batches = [
            np.concatenate([rows[row] for row in batch])
            for batch in np.array_split(np.arange(len(rows)), min(BATCHES, len(rows)))
        ]
        values = np.concatenate(self.batches)
        order = np.argsort(values, kind="stable")
        owners = np.repeat(np.arange(len(self.batches)), [len(batch) for batch in self.batches])[order]
        self.values: Floats = values[order]
        self.counts = np.cumsum(owners[:, None] == np.arange(len(self.batches)), axis=0)
        self.levels = np.array([row[0] if len(row) == 1 else np.median(row) for row in rows])

    def allows(self, statistic: str) -> bool:
        quantile = STATISTICS[statistic] or 0.0
        return self.n_rows >= FEWEST_ROWS and (
            statistic == "median" or round(len(self.values) * (1 - quantile), 6) >= FEWEST_BEYOND
        )

    def statistic(self, name: str) -> float:
        quantile = STATISTICS[name]
        return float(self.values.mean() if quantile is None else np.quantile(self.values, quantile))

    def draw(self, rng: np.random.Generator) -> NDArray[np.int64]:
        n = len(self.batches)
        return rng.multinomial(n, [1 / n] * n, size=_RESAMPLES)

    def replicate(self, name: str, drawn: NDArray[np.int64]) -> Floats:
        quantile = STATISTICS[name]
        sizes = drawn @ self.counts[-1]
        if quantile is None:
            sums = np.array([batch.sum() for batch in self.batches])
            return np.asarray(drawn @ sums / sizes)
        place = quantile * (sizes - 1)
        low = self._ranked(drawn, np.floor(place))
        return np.asarray(low + (place % 1) * (self._ranked(drawn, np.ceil(place)) - low))

    def _ranked(self, drawn: NDArray[np.int64], ranks: Floats) -> Floats:
        """Return the value of a rank, from 0, in every resample, by bisection of the sorted values."""
        low = np.zeros(len(drawn), dtype=np.int64)
        high = np.full(len(drawn), len(self.values) - 1)
        while (low < high).any():
            middle = (low + high) // 2
            reached = (self.counts[middle] * drawn).sum(axis=1) > ranks
            low, high = np.where(reached, low, middle + 1), np.where(reached, middle, high)
        return self.values[low]


def lag_one(values: Floats) -> float:
    """Return the lag-1 autocorrelation of values in their order, r1; 0 if they are equal but for rounding."""
    around = values - values.mean()
    if np.ptp(around) <= _ROUNDING * np.abs(values).max():
        return 0.0
    return float(around[1:] @ around[:-1]) / float(around @ around)


@dataclass(frozen=True, slots=True)
class RowCorrelation:
    """Correlation of neighbours in a series of ``n`` rows, which is cut into ``k`` batches.

    ``r``, from 0 to 0.95, is the lag-1 correlation of ranks, which is robust to outliers.
    """

    r: float
    n: int
    k: int

    @classmethod
    def of(cls, levels: Floats) -> RowCorrelation:
        from scipy import stats

        r = min(0.95, max(0.0, lag_one(stats.rankdata(levels))))
        return cls(r, len(levels), min(BATCHES, len(levels)))

    @property
    def effective(self) -> float:
        """Return the equivalent number of independent rows: n (1 - r) / (1 + r)."""
        return self.n * (1 - self.r) / (1 + self.r)

    @property
    def dependent(self) -> bool:
        """Whether the correlation length, about (1 + r) / (1 - r) rows, exceeds a batch, beyond chance."""
        return self.effective < self.k and self.r > CHANCE / math.sqrt(self.n)

    @property
    def hidden(self) -> float:
        """Return the factor by which the variance between correlated batches underestimates that of their mean.

        The rows are modelled as an autoregressive series of order 1, whose mean over m rows has the variance below.
        """
        r, n, k = self.r, self.n, self.k

        def variance(m: float) -> float:
            return float((1 + r) / (1 - r) - 2 * r * (1 - r**m) / (m * (1 - r) ** 2)) / m

        return variance(n) * (k - 1) / (variance(n / k) - variance(n)) if k > 1 else 1.0
