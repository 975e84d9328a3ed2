"""Summaries of repeated measurements, and the ratio of two medians with its bootstrap interval."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

Values: TypeAlias = "Sequence[float] | Sequence[Sequence[float]] | Floats"
"""One value a block, or one row of values a block."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What n values look like; ``sd`` is the sample standard deviation (n - 1), None for a single value."""

    n: int
    mean: float
    sd: float | None
    median: float
    p90: float
    p99: float


@dataclass(frozen=True, slots=True)
class Ratio:
    """A ratio and its confidence interval; None where the values do not allow one, never NaN."""

    value: float | None
    low: float | None
    high: float | None


def summarise(values: Iterable[float]) -> Summary:
    """Summarise values; percentiles interpolate linearly (Hyndman and Fan, type 7). Raises ValueError for none."""
    import numpy as np

    array = np.asarray(list(values), dtype=np.float64)
    if not array.size:
        raise ValueError("there is no summary of no values")
    median, p90, p99 = np.percentile(array, (50, 90, 99))
    sd = float(array.std(ddof=1)) if array.size > 1 else None
    return Summary(array.size, float(array.mean()), sd, float(median), float(p90), float(p99))


def ratio_of_medians(
    numerator: Values,
    denominator: Values,
    *,
    seed: int,
    confidence: float = 0.95,
    resamples: int = 2000,
    paired: bool = True,
) -> Ratio:
    """Divide the median of one cell by that of another, with a percentile bootstrap interval.

    Element i of both belongs to block i, in which the cells ran side by side: whole blocks are resampled, so what
    slowed both cells down at once cancels. Cells of unequal length, or not ``paired``, are resampled independently.
    """
    import numpy as np

    above, below = np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    value = _divide(np.median(above), np.median(below)) if above.size and below.size else None
    if value is None or min(len(above), len(below)) < 2:  # noqa: PLR2004 - one block says nothing about the spread
        return Ratio(value, None, None)
    paired = paired and len(above) == len(below)
    low, high = _bootstrap(above, below, np.random.default_rng(seed), confidence, resamples, paired)
    return Ratio(value, _finite(low), _finite(high))


def _bootstrap(
    above: Floats, below: Floats, rng: np.random.Generator, confidence: float, resamples: int, paired: bool
) -> tuple[float, float]:
    """Resample block numbers and return the interval.

    The percentile method, because the jackknife inside BCa is inconsistent for medians (Efron and Tibshirani 1993,
    section 11.7).
    """
    import numpy as np
    from scipy import stats

    def median(values: Floats, blocks: Any) -> Floats:
        picked = values[blocks.astype(np.intp)]
        return np.asarray(np.median(picked.reshape(*blocks.shape, -1), axis=(-2, -1)))

    def ratio(blocks_above: Any, blocks_below: Any, axis: int = -1) -> Floats:
        if axis != -1:
            raise ValueError("resamples lie along the last axis")
        return np.asarray(median(above, blocks_above) / median(below, blocks_below))

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # Values without spread, or zeros among them, are answered by None, not by a warning.
        warnings.simplefilter("ignore")
        interval = stats.bootstrap(
            (np.arange(len(above)), np.arange(len(below))),
            ratio,
            paired=paired,
            vectorized=True,
            axis=-1,
            n_resamples=resamples,
            confidence_level=confidence,
            method="percentile",
            random_state=rng,
        ).confidence_interval
    return float(interval.low), float(interval.high)


def _divide(above: Any, below: Any) -> float | None:
    """Divide, or return None where that gives no number."""
    return _finite(float(above) / float(below)) if below else None


def _finite(value: float) -> float | None:
    """Return the value, or None where it is no number."""
    return value if math.isfinite(value) else None


def summary_of(values: NDArray[np.float64]) -> Summary | None:
    """Summarise values; None where there are none."""
    return summarise(values) if values.size else None
