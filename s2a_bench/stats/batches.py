"""Uncertainty of one launch's statistics: the launch is cut into batches of time, which are resampled."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.stats import Floats

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


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The values of one launch in order of time, a row a request: its value, or the gaps of its tokens."""

    values: Floats
    sizes: NDArray[np.int64] | None = None
    """The number of values of each row, at least 1; None if every row is one value."""

    @classmethod
    def of(cls, rows: Sequence[Floats]) -> Rows:
        """Join rows of one array each, without the empty ones."""
        sizes = np.array([len(row) for row in rows if len(row)], dtype=np.int64)
        return cls(np.concatenate([np.empty(0), *rows]), sizes)

    def __len__(self) -> int:
        return len(self.values if self.sizes is None else self.sizes)

    @property
    def levels(self) -> Floats:
        """Return the median of each row."""
        if self.sizes is None:
            return self.values
        levels = np.empty(len(self.sizes))
        starts = np.cumsum(self.sizes) - self.sizes
        for size in np.unique(self.sizes):
            alike = self.sizes == size
            levels[alike] = np.median(self.values[starts[alike, None] + np.arange(size)], axis=1)
        return levels

    def cut(self, n: int) -> list[Floats]:
        """Cut the values into n batches of about as many whole rows."""
        if self.sizes is None:
            return np.array_split(self.values, n)
        ends = [int(batch[-1]) for batch in np.array_split(np.cumsum(self.sizes), n)]
        return np.split(self.values, ends[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """The values of a cell in one launch, and the block of each, in ascending order."""

    values: Floats
    block: NDArray[np.int64]

    @classmethod
    def by_launch(cls, values: Floats, launch: NDArray[np.int64], block: NDArray[np.int64]) -> dict[int, Blocks]:
        """Sort values by launch and block; those of a block keep their order."""
        order = np.argsort(block, kind="stable")
        values, launch, block = values[order], launch[order], block[order]
        return {int(each): cls(values[launch == each], block[launch == each]) for each in np.unique(launch)}

    def __len__(self) -> int:
        return len(self.values)

    def shared(self, other: Blocks) -> Blocks:
        """Return the values of the blocks that ``other`` has too."""
        both = np.isin(self.block, other.block)
        return Blocks(self.values[both], self.block[both])


@final
class LaunchValues:
    """The values of one launch in up to `BATCHES` batches of rows, none empty; percentiles are found by sorted rank."""

    def __init__(self, rows: Rows) -> None:
        self.n_rows = len(rows)
        self.levels = rows.levels
        self.batches = rows.cut(min(BATCHES, len(rows)))
        self.ordered = [np.sort(batch) for batch in self.batches]
        self.values: Floats = np.sort(rows.values)

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

    def replicate(self, name: str, weights: NDArray[np.int64]) -> Floats:
        quantile = STATISTICS[name]
        sizes = weights @ np.array([len(batch) for batch in self.batches])
        if quantile is None:
            sums = np.array([batch.sum() for batch in self.batches])
            return np.asarray(weights @ sums / sizes)
        window, counts = self._window(quantile)

        def ranked(ranks: Floats) -> Floats:
            """Return the value of a rank, from 0, in every resample, by bisection."""
            low, high = np.zeros(len(weights), dtype=np.int64), np.full(len(weights), len(window) - 1)
            while (low < high).any():
                middle = (low + high) // 2
                reached = (counts[middle] * weights).sum(axis=1) > ranks
                low, high = np.where(reached, low, middle + 1), np.where(reached, middle, high)
            return window[low]

        place = quantile * (sizes - 1)
        low = ranked(np.floor(place))
        return np.asarray(low + (place % 1) * (ranked(np.ceil(place)) - low))

    def _window(self, quantile: float) -> tuple[Floats, NDArray[np.int32]]:
        """Return the sorted values that may be a resample's quantile, and how many of each batch are up to each.

        A quantile of several batches together lies between the least and the greatest of their own.
        """
        places = [(batch, quantile * (len(batch) - 1)) for batch in self.ordered]
        least = min(batch[math.floor(place)] for batch, place in places)
        greatest = max(batch[math.ceil(place)] for batch, place in places)
        first, end = np.searchsorted(self.values, least), np.searchsorted(self.values, greatest, "right")
        window = self.values[first:end]
        counts = [np.searchsorted(batch, window, "right").astype(np.int32) for batch in self.ordered]
        return window, np.stack(counts, axis=1)


def lag_one(values: Floats) -> float:
    """Return the lag-1 autocorrelation of values in their order, r1; 0 if they are equal but for rounding."""
    around = values - values.mean()
    if np.ptp(around) <= _ROUNDING * np.abs(values).max():
        return 0.0
    return float(around[1:] @ around[:-1]) / float(around @ around)


def ranks_of(values: Floats) -> Floats:
    """Return the rank of each value from 1, for equal ones the mean, without the half second to import scipy.stats."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[places])


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
        r = min(0.95, max(0.0, lag_one(ranks_of(levels))))
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
