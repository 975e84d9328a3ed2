"""Ratios and differences of means with their 95 % intervals, as claims are judged by them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from s2a_bench.report.claims.claim import UNDECIDED, Said, within
from s2a_bench.stats.change import change_between

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2a_bench.stats import Ratio
    from s2a_bench.stats.change import Change

    Floats = NDArray[np.float64]

LIKE: Final = 0.10
"""Means within this share of the paper's are called the same: it gives no spread from machine to machine."""
TOO_FEW: Final = "Too few samples for an interval."


def change(above: Floats, below: Floats, seed: int, *, paired: bool = False, exact: bool = False) -> Change:
    """Compare the means of two sides in order of time; ``paired`` where row i of both belongs together."""
    rows = [[values[place : place + 1] for place in range(len(values))] for values in (below, above)]
    return change_between(rows[:1], rows[1:], "mean", seed=seed, paired=paired, exact=exact)


def verdict_of(ratio: Ratio, least: float, most: float = float("inf")) -> str:
    """Judge whether a ratio lies between two bounds; undecided where it has no interval."""
    if ratio.low is None or ratio.high is None:
        return UNDECIDED
    return within(ratio.low, ratio.high, least, most)


def near(mean: Ratio, said: str) -> Said:
    """Judge whether a ratio of ours to the paper's is 1 within `LIKE`."""
    verdict = verdict_of(mean, 1 - LIKE, 1 + LIKE)
    return verdict, said if mean.low is not None else f"{said} {TOO_FEW}"
