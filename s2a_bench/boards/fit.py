"""Choose the family of `gaps` that describes recorded gaps: each is fitted to one half and compared with the other.

The distance is Kolmogorov and Smirnov's, of single gaps and of sums over a skill's tokens, whichever is larger: only
the sums distinguish grouped pauses from single ones. A family with fewer parameters is chosen unless a richer one is
nearer by more than the noise of a sample of this size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeAlias

import numpy as np

from s2a_bench.boards.gaps import Floats, Gaps, Lognormal, Markov, Quantiles

Rows: TypeAlias = Sequence[Sequence[float]]
"""Gaps in s, one row a request."""

SKILL_TOKENS = 6
_DRAWS = 20_000
_EM_STEPS = 200
_STEPS = 50
_FINER = 30
_LEAST_GAPS = 40


@dataclass(frozen=True, slots=True)
class Fit:
    """The chosen family, fitted to all gaps, and each family's distance from the half it was not fitted to."""

    gaps: Gaps
    family: str
    distances: dict[str, tuple[float, float]]
    """Family -> (of single gaps, of sums over a skill)."""
    lag1: float


def fit_gaps(rows: Rows) -> Fit:
    """Choose among FITS; raises ValueError for fewer than 40 gaps."""
    rows = [row for row in rows if len(row)]
    if sum(map(len, rows)) < _LEAST_GAPS:
        raise ValueError(f"a fit needs {_LEAST_GAPS} gaps, there are {sum(map(len, rows))}")
    half = len(rows[0]) // 2
    halves: tuple[Rows, Rows] = (rows[::2], rows[1::2]) if len(rows) > 1 else ([rows[0][:half]], [rows[0][half:]])
    distances = {}
    for name, fit in FITS.items():
        gap, total = np.mean([_distances(fit(halves[side]), halves[1 - side]) for side in (0, 1)], axis=0).tolist()
        distances[name] = (gap, total)
    near = min(map(max, distances.values())) + 1 / np.sqrt(sum(map(len, rows)) / 2)
    family = next(name for name, distance in distances.items() if max(distance) <= near)
    return Fit(FITS[family](rows), family, distances, lag1(rows))


def lag1(rows: Rows) -> float:
    """Return the correlation of a gap with the next within requests; 0 if gaps do not vary."""
    centred = [np.asarray(row) - np.mean(row) for row in rows if len(row) > 1]
    power = sum(float(row @ row) for row in centred)
    return sum(float(row[1:] @ row[:-1]) for row in centred) / power if power else 0.0


def fit_lognormal(rows: Rows) -> Lognormal:
    """Fit by maximum likelihood, with the mean of the gaps."""
    gaps = _flat(rows)
    mean = float(gaps.mean())
    square = float(np.mean(np.log(gaps / mean) ** 2))
    variance = 2 * (np.sqrt(1 + square) - 1)  # the root of the likelihood's derivative, as the mean fixes the median
    return Lognormal(mean, float(np.sqrt(np.expm1(variance))))


def fit_markov(rows: Rows) -> Markov:
    """Fit two lognormal states by expectation maximisation, then the length of pauses by the sequence of states."""
    logs = np.log(_flat(rows))
    low, high = np.quantile(logs, (0.5, 0.99))
    share, variance = 0.05, max(float(logs.var()) / 4, 1e-9)
    pause = np.zeros_like(logs)
    for _ in range(_EM_STEPS):
        odds = np.log((1 - share) / share) + ((logs - high) ** 2 - (logs - low) ** 2) / (2 * variance)
        pause = 1 / (1 + np.exp(np.clip(odds, -500, 500)))  # exp overflows above 709
        share = float(np.clip(pause.mean(), 1e-6, 1 - 1e-6))
        low = np.average(logs, weights=1 - pause + 1e-12)
        high = np.average(logs, weights=pause + 1e-12)
        variance = max(float(np.mean((1 - pause) * (logs - low) ** 2 + pause * (logs - high) ** 2)), 1e-9)
    if high < low:
        low, high, share, pause = high, low, 1 - share, 1 - pause
    rest = np.split(pause > 0.5, np.cumsum([len(row) for row in rows])[:-1])  # noqa: PLR2004 - more likely than not
    followed = sum(int(row[:-1].sum()) for row in rest)
    left = sum(int((row[:-1] & ~row[1:]).sum()) for row in rest)
    stay = followed / left if left else float(max(followed, 1))
    share = min(share, 0.999)
    return Markov(
        float(_flat(rows).mean()),
        cv=float(np.sqrt(np.expm1(variance))),
        pause_share=share,
        pause_ratio=float(np.exp(high - low)),
        pause_tokens=max(stay, 1 / (1 - share)),
    )


def fit_quantiles(rows: Rows) -> Quantiles:
    """Take the gaps' quantiles in steps of 2 %, in smaller ones where lines miss the gaps' sum most, as at pauses.

    The rest of the sum is added to the largest quantile, so that the right mean does not move the body.
    """
    gaps = np.sort(_flat(rows))
    last = len(gaps) - 1
    total = np.concatenate(([0.0], np.cumsum((gaps[1:] + gaps[:-1]) / 2)))  # the area under the quantiles
    knots = np.unique(np.linspace(0, last, _STEPS + 1).round().astype(int))
    for _ in range(_FINER):
        widths = np.diff(knots)
        missed = np.abs(np.diff(total[knots]) - widths * (gaps[knots[1:]] + gaps[knots[:-1]]) / 2) * (widths > 1)
        place = int(missed.argmax())
        if missed[place] > 0:
            knots = np.insert(knots, place + 1, (knots[place] + knots[place + 1]) // 2)
    values, width = gaps[knots], knots[-1] - knots[-2]
    missing = gaps.mean() * last - np.diff(knots) @ (values[1:] + values[:-1]) / 2
    values[-1] = max(values[-2], values[-1] + 2 * missing / width)
    return Quantiles(float(gaps.mean()), tuple((knots / last).tolist()), tuple(values.tolist()))


FITS: dict[str, Callable[[Rows], Gaps]] = {
    "lognormal": fit_lognormal,
    "markov": fit_markov,
    "quantiles": fit_quantiles,
}
"""Family -> its fit, the one with the fewest parameters first."""


def _distances(gaps: Gaps, rows: Rows) -> tuple[float, float]:
    """Return the distance of single gaps and that of sums over a skill, 0 if no request is that long."""
    from scipy.stats import ks_2samp

    gaps_s = gaps.sample(np.random.default_rng(0), SKILL_TOKENS, _DRAWS)
    starts = range(0, max(map(len, rows)) - SKILL_TOKENS + 1, SKILL_TOKENS)
    sums = [sum(row[at : at + SKILL_TOKENS]) for row in rows for at in starts if at + SKILL_TOKENS <= len(row)]
    single = float(ks_2samp(_flat(rows), gaps_s[0]).statistic)
    return single, float(ks_2samp(sums, gaps_s.sum(axis=0)).statistic) if sums else 0.0


def _flat(rows: Rows) -> Floats:
    return np.maximum(np.fromiter(chain.from_iterable(rows), np.float64), 1e-9)  # a clock's tick, for the logarithm
