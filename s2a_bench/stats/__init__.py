"""Summaries of repeated measurements; `change` has intervals and tests for differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from s2a_bench.bounds import Many, NonNegative

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of n values; ``sd`` is the sample standard deviation (n - 1), None for a single value."""

    n: Many
    median: float
    mean: float
    sd: NonNegative | None
    p90: float
    p99: float


@dataclass(frozen=True, slots=True)
class SummaryEnds:
    """Summaries of the lower and of the upper ends of intervals: the true values' statistics lie between the two.

    That holds for the median, the mean and the percentiles, not for ``sd``.
    """

    lo: Summary
    hi: Summary


@dataclass(frozen=True, slots=True)
class Ratio:
    """A ratio and its confidence interval; None if the values do not allow one, never NaN.

    The interval of one launch does not cover differences between launches; that of several does. ``launch_sd`` is the
    standard deviation of the logarithms of their ratios: about the relative difference between launches.
    """

    value: float | None
    low: float | None
    high: float | None
    launches: int = 1
    launch_sd: float | None = None

    @property
    def ci95(self) -> tuple[float, float] | None:
        return None if self.low is None or self.high is None else (self.low, self.high)


def summarise(values: Floats | Sequence[float]) -> Summary:
    """Summarise values; percentiles interpolate linearly (Hyndman and Fan, type 7). Raises ValueError for none."""
    import numpy as np

    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        raise ValueError("a summary needs at least one value")
    median, p90, p99 = np.percentile(array, (50, 90, 99))
    sd = float(array.std(ddof=1)) if array.size > 1 else None
    return Summary(array.size, float(median), float(array.mean()), sd, float(p90), float(p99))


def summary_of(values: Floats) -> Summary | None:
    """Summarise values; None for no values."""
    return summarise(values) if values.size else None
