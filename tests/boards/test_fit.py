"""Gaps of known families: the right one is chosen, its parameters are found, and unseen gaps do not reject it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ks_2samp

from s2a_bench.boards.fit import FITS, fit_gaps, fit_lognormal, fit_markov, fit_quantiles, lag1
from s2a_bench.boards.gaps import Bursty, Constant, Gaps, Lognormal, Markov, Quantiles, Recorded

LOGNORMAL = Lognormal(0.21, 0.2)
MARKOV = Markov(0.21, 0.1, 0.05, 12, 6)
TWO_SPEEDS = Quantiles(0.02, (0, 0.45, 0.55, 1), (1, 1.1, 1.9, 2))
RARE_PAUSES = Quantiles(0.02, (0, 0.5, 0.96, 0.97, 1), (1, 1.02, 1.3, 6, 20))


def rows_of(gaps: Gaps, seed: int, requests: int = 60, tokens: int = 63) -> list[list[float]]:
    drawn: list[list[float]] = gaps.sample(np.random.default_rng(seed), tokens, requests).T.tolist()
    return drawn


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("truth", "family"),
    [(LOGNORMAL, "lognormal"), (MARKOV, "markov"), (TWO_SPEEDS, "quantiles"), (RARE_PAUSES, "quantiles")],
    ids=["lognormal", "markov", "two speeds", "rare pauses"],
)
def test_the_family_is_found_and_gaps_it_has_not_seen_do_not_reject_it(truth: Gaps, family: str, seed: int) -> None:
    rows = rows_of(truth, seed)
    fit = fit_gaps(rows)
    assert fit.family == family
    assert fit.gaps.mean_s == pytest.approx(np.mean(rows), rel=1e-12)
    unseen = np.ravel(rows_of(truth, 100 + seed, requests=20))
    if family == "markov":  # pauses come together: gaps 63 tokens apart are independent, as the test wants them
        unseen = np.array([row[seed] for row in rows_of(truth, 100 + seed, requests=1000)])
    played = fit.gaps.sample(np.random.default_rng(200 + seed), 1, 1000)[0]
    assert ks_2samp(unseen, played).pvalue > 0.01


def test_distances_tell_a_wrong_family_from_a_right_one() -> None:
    distances = fit_gaps(rows_of(MARKOV, 1)).distances
    assert max(distances["markov"]) < 0.06
    assert distances["lognormal"][0] > 0.15
    assert distances["quantiles"][0] < 0.04
    assert distances["quantiles"][1] > 0.1  # the sums show that pauses cluster


def test_lognormal_is_the_likeliest_of_its_mean() -> None:
    rows = rows_of(RARE_PAUSES, 4)
    logs, best = np.log(np.ravel(rows)), fit_lognormal(rows)

    def likelihood(cv: float) -> float:
        variance = np.log1p(cv**2)
        centre = np.log(best.mean_s) - variance / 2
        return float(np.mean(-np.log(variance) / 2 - (logs - centre) ** 2 / (2 * variance)))

    assert likelihood(best.cv) > max(likelihood(best.cv * 1.01), likelihood(best.cv / 1.01))


def test_markov_parameters_are_found() -> None:
    rows = rows_of(MARKOV, 5, requests=600)
    fit = fit_markov(rows)
    assert fit.pause_share == pytest.approx((np.array(rows) > 4 * MARKOV.normal_s).mean(), rel=1e-3)
    assert fit.pause_ratio == pytest.approx(12, rel=0.02)
    assert fit.pause_tokens == pytest.approx(6, rel=0.1)
    assert fit.cv == pytest.approx(0.1, rel=0.02)


def test_quantiles_keep_the_mean_without_moving_the_body() -> None:
    rows = rows_of(RARE_PAUSES, 6)
    fit = fit_quantiles(rows)
    assert np.interp(0.5, fit.levels, fit.quantiles_s()) == pytest.approx(np.median(rows), rel=1e-3)
    drawn = fit.sample(np.random.default_rng(0), 1000, 1000)
    assert drawn.mean() == pytest.approx(np.mean(rows), rel=0.01)


@pytest.mark.parametrize("gaps", [Constant(0.1), Bursty(0.1, 0.0, 8, 0.0), Recorded(0.1, (1.0, 1.0, 5.0))])
def test_gaps_without_spread_or_of_length_0_are_fitted_all_the_same(gaps: Gaps) -> None:
    for fit in FITS.values():
        drawn = fit(rows_of(gaps, 7)).sample(np.random.default_rng(1), 10, 100)
        assert np.isfinite(drawn).all()
    assert fit_gaps(rows_of(gaps, 7)).gaps.mean_s == pytest.approx(0.1, rel=0.02)


def test_one_long_request_is_enough_and_40_gaps_are_needed() -> None:
    assert fit_gaps(rows_of(LOGNORMAL, 8, requests=1, tokens=200)).family == "lognormal"
    assert fit_gaps([[], *rows_of(LOGNORMAL, 8, requests=10, tokens=4)]).family == "lognormal"
    with pytest.raises(ValueError, match="a fit needs 40 gaps, there are 39"):
        fit_gaps(rows_of(LOGNORMAL, 8, requests=13, tokens=3))


def test_lag1_is_that_of_an_alternating_sequence_and_of_a_slow_one() -> None:
    assert lag1([[1.0, 2.0] * 500]) == pytest.approx(-1, abs=0.01)
    assert lag1([[1.0] * 500 + [2.0] * 500]) == pytest.approx(1, abs=0.01)
    assert lag1([[3.0, 3.0], [4.0, 4.0]]) == 0
