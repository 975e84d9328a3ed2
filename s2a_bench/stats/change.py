"""Change of a statistic between two sides: effect sizes with intervals, one test, and its power."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from s2a_bench.stats import Floats, Ratio
from s2a_bench.stats.batches import FEWEST_ROWS, Blocks, LaunchValues, RowCorrelation, Rows, ranks_of

_Launch = TypeVar("_Launch")

CONFIDENCE: Final = 0.95
POWER: Final = 0.8
"""Probability of finding the smallest detectable change (Cohen 1988)."""

FEWEST_LAUNCHES: Final = 3
"""Launches below which their differences are not known well enough for a verdict."""

_MOST: Final = 50.0
"""Limit of the logarithm of a ratio."""


@dataclass(frozen=True, slots=True)
class Noise:
    """The standard error of a change with its degrees of freedom: of a logarithm, or as a share of the baseline."""

    error: float
    freedom: float
    logarithmic: bool = True

    def detectable(self, level: float, *, falls: bool = False) -> float:
        """Return the smallest rise (or fall), over the baseline, that a two-sided t test finds with `POWER`."""
        from scipy import special

        if not self.error:
            return 0.0
        critical = -float(special.stdtrit(self.freedom, level / 2))
        shift = float(special.nctdtrinc(self.freedom, 1 - POWER, critical)) * self.error
        if not self.logarithmic:
            return shift
        return -math.expm1(-shift) if falls else math.expm1(min(shift, _MOST))


@dataclass(frozen=True, slots=True)
class Change:
    """A statistic of ``other`` against ``baseline``: as a ratio, as a difference, and as a probability.

    ``superiority`` is the probability that a value of ``other`` is the larger of two, ties counted half (Vargha and
    Delaney 2000); 0.5 means no difference. ``p`` is None where there are too few values for an interval.
    ``dependent`` is true if neighbours correlate so much that batches are not independent: the interval is too narrow.
    ``noise`` is the standard error of the test, None if the uncertainty as a share is unknown.
    """

    baseline: float
    other: float
    ratio: Ratio
    difference: Ratio
    superiority: Ratio
    p: float | None
    dependent: bool
    noise: Noise | None

    @property
    def relative(self) -> float | None:
        """Return the change as a share of the baseline's size; None for a change from zero."""
        if self.other == self.baseline:
            return 0.0
        if self.ratio.value is not None:
            return self.ratio.value - 1
        return None if self.baseline == 0 else (self.other - self.baseline) / abs(self.baseline)

    @property
    def bounds(self) -> tuple[float, float] | None:
        if self.ratio.low is not None and self.ratio.high is not None:
            return self.ratio.low - 1, self.ratio.high - 1
        low, high = self.difference.low, self.difference.high
        if low is None or high is None or (self.baseline == 0 and (low, high) != (0, 0)):
            return None
        return low / (abs(self.baseline) or 1), high / (abs(self.baseline) or 1)


def change_between(
    baseline: Sequence[Rows],
    other: Sequence[Rows],
    statistic: str,
    *,
    seed: int,
    exact: bool = False,
    paired: bool = False,
) -> Change:
    """Compare a statistic of two sides, each of one launch or more; every launch has at least one value.

    ``exact`` values are computed, not sampled: any difference counts. ``paired`` sides are cells of one launch: row i
    of both was measured in block i, so the same batches are drawn of both, and common slow-downs cancel.

    The test is Welch's t on the logarithm of the statistic (on the statistic itself if it may be zero or less); the
    interval uses the same t, so both agree. The spread of a side is

    - of several launches, that of the launches' values (Kalibera and Jones 2013);
    - of one launch, that of its requests, in order of time, cut into `BATCHES` batches, which are drawn with
      replacement (a bootstrap of batches, n - 1 degrees of freedom). So correlated neighbours, or a slow trend, widen
      the interval. Differences between launches are not in it.
    """
    rng = np.random.default_rng(seed)
    launches = [[LaunchValues(rows) for rows in side] for side in (baseline, other)]
    draws = [side[0].draw(rng) if len(side) == 1 else None for side in launches]
    if paired:
        draws[1] = draws[0]
    below, above = (_Side.of(side, statistic, each, exact) for side, each in zip(launches, draws, strict=True))
    test = plain = _Test.of(below, above, paired)
    ratio = Ratio(above.mean / below.mean if below.mean > 0 else None, None, None)
    logarithmic = below.positive and above.positive
    if logarithmic:
        test = _Test.of(below.log(), above.log(), paired)
        low, high = (None if bound is None else math.exp(bound) for bound in (test.shift.low, test.shift.high))
        ratio = Ratio(above.level / below.level, low, high)
    unit = 1.0 if logarithmic else abs(below.level)
    noise = None
    if test.p is not None and (unit or not test.error):
        noise = Noise(test.error / unit if test.error else 0.0, test.freedom, logarithmic)
    superiority = _superiority(launches, draws)
    return Change(below.level, above.level, ratio, plain.shift, superiority, test.p, test.dependent, noise)


def change_of_ranks(baseline: Rows, other: Rows) -> Change:
    """Compare the ranks of two launches' values: the rank test of Wilcoxon, with the batches of `change_between`."""
    ranks = ranks_of(np.concatenate([baseline.values, other.values]))
    below, above = np.split(ranks, [len(baseline.values)])
    return change_between([Rows(below, baseline.sizes)], [Rows(above, other.sizes)], "mean", seed=0)


def ratio_of_launches(
    above: Mapping[_Launch, Blocks],
    below: Mapping[_Launch, Blocks],
    seed: int,
    statistic: Literal["median", "mean"] = "median",
) -> Ratio | None:
    """Divide the medians (or means) of two cells, given by launch and block; None if no launch has values of both.

    One launch: `change_between` of its blocks, paired if both cells have the same. Several: the geometric mean of their
    ratios, with the interval of Student's t on the logarithms, which includes differences between launches.
    """
    from scipy import special

    both = [launch for launch in above if above[launch] and below.get(launch)]
    if not both:
        return None
    if len(both) == 1:
        cells = [below[both[0]], above[both[0]]]
        blocks, sizes = zip(*(np.unique(cell.block, return_counts=True) for cell in cells), strict=True)
        first, second = map(Rows, (cell.values for cell in cells), sizes)
        return change_between([first], [second], statistic, seed=seed, paired=np.array_equal(*blocks)).ratio
    middle = np.median if statistic == "median" else np.mean
    middles = np.array([[middle(cell[launch].values) for launch in both] for cell in (above, below)])
    n = len(both)
    if not (middles > 0).all():
        over = float(middles[1].mean())
        return Ratio(float(middles[0].mean()) / over if over > 0 else None, None, None, n)
    logs = np.log(middles[0] / middles[1])
    centre, sd = float(logs.mean()), float(logs.std(ddof=1))
    reach = float(special.stdtrit(n - 1, 0.975)) * sd / math.sqrt(n)
    return Ratio(math.exp(centre), math.exp(centre - reach), math.exp(centre + reach), n, sd)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p-values for their number (Holm 1979); None, for no test, stays None and does not count."""
    tests = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    highest = 0.0
    for rank, (p, index) in enumerate(tests):
        highest = max(highest, min(1.0, p * (len(tests) - rank)))
        corrected[index] = highest
    return corrected


@dataclass(frozen=True)
class _Side:
    """A statistic of one side: of each launch; of every resample, and of every row, if there is only one launch."""

    points: Floats
    copies: Floats | None
    levels: Floats
    exact: bool

    @classmethod
    def of(
        cls, launches: Sequence[LaunchValues], statistic: str, draws: NDArray[np.int64] | None, exact: bool
    ) -> _Side:
        first = launches[0]
        points = np.array([launch.statistic(statistic) for launch in launches])
        copies = first.replicate(statistic, draws) if draws is not None and first.allows(statistic) else None
        return cls(points, copies, first.levels, exact)

    @property
    def positive(self) -> bool:
        return all((values > 0).all() for values in (self.points, self.copies) if values is not None)

    def log(self) -> _Side:
        copies = None if self.copies is None else np.log(self.copies)
        levels = np.log(np.maximum(self.levels, np.finfo(np.float64).tiny))  # a row may be zero; only ranks count
        return _Side(np.log(self.points), copies, levels, self.exact)

    def less(self, other: _Side) -> _Side:
        copies = None if self.copies is None or other.copies is None else self.copies - other.copies
        return _Side(self.points - other.points, copies, self.levels - other.levels, self.exact)

    @property
    def mean(self) -> float:
        return float(self.points.mean())

    @property
    def level(self) -> float:
        if len(self.points) == 1 or not self.positive:
            return self.mean
        return math.exp(self.log().mean)

    @property
    def dependent(self) -> bool:
        return len(self.points) == 1 and self.memory.dependent

    @cached_property
    def memory(self) -> RowCorrelation:
        return RowCorrelation.of(self.levels)

    @property
    def variance(self) -> tuple[float, int] | None:
        if self.exact:
            return 0.0, 1
        if (n := len(self.points)) > 1:
            return float(self.points.var(ddof=1)) / n, n - 1
        if self.copies is None:
            return None
        # Drawing k batches with replacement shows (k - 1) / k of the variance.
        k = self.memory.k
        # Equal values have no variance, despite rounding.
        varies = self.copies.max() > self.copies.min()
        return (float(self.copies.var()) * k / (k - 1) * self.memory.hidden if varies else 0.0), k - 1


@dataclass(frozen=True, slots=True)
class _Test:
    """Welch's t of two means, Student's of paired ones; no interval and no p if a side's variance is unknown."""

    shift: Ratio
    p: float | None
    dependent: bool
    error: float = 0.0
    freedom: float = math.inf

    @classmethod
    def of(cls, below: _Side, above: _Side, paired: bool) -> _Test:
        from scipy import special

        sides = [above.less(below)] if paired else [below, above]
        dependent = any(side.dependent for side in sides)
        shift = above.mean - below.mean
        variances = [variance for side in sides if (variance := side.variance) is not None]
        if len(variances) < len(sides):
            return cls(Ratio(shift, None, None), None, dependent)
        total = sum(variance for variance, _ in variances)
        if total == 0:  # no variance: every difference is certain
            return cls(Ratio(shift, shift, shift), 0.0 if shift else 1.0, dependent)
        freedom = total**2 / sum(variance**2 / df for variance, df in variances)
        error = math.sqrt(total)
        reach = float(special.stdtrit(freedom, (1 + CONFIDENCE) / 2)) * error
        p = float(2 * special.stdtr(freedom, -abs(shift) / error))
        return cls(Ratio(shift, shift - reach, shift + reach), p, dependent, error, freedom)


def _superiority(sides: Sequence[Sequence[LaunchValues]], draws: Sequence[NDArray[np.int64] | None]) -> Ratio:
    """Return P(other > baseline) + P(equal) / 2, with a percentile interval over the batches of two single launches."""
    below, above = (
        side[0].ordered if len(side) == 1 else [np.sort(np.concatenate([launch.values for launch in side]))]
        for side in sides
    )
    wins = np.array([[_wins(one, two) for two in below] for one in above])
    pairs = np.outer([len(one) for one in above], [len(two) for two in below])
    value = float(wins.sum() / pairs.sum())
    first, second = draws
    if first is None or second is None or any(side[0].n_rows < FEWEST_ROWS for side in sides):
        return Ratio(value, None, None)
    resampled = ((second @ wins) * first).sum(axis=1) / ((second @ pairs) * first).sum(axis=1)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(resampled, (tail, 1 - tail))
    return Ratio(value, float(low), float(high))


def _wins(above: Floats, below: Floats) -> float:
    """Count the pairs of values, which are sorted, of which the one above is larger; ties count half."""
    return float(sum(np.searchsorted(below, above, side).sum() for side in ("left", "right"))) / 2
