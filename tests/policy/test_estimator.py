"""What is known of a plan's rate: the prior, what tokens add to it, and where the prior comes from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from s2a_bench.boards.gaps import Lognormal
from s2a_bench.errors import UsageError
from s2a_bench.policy.estimator import VAGUE, GapPrior

SHORT = [(2, 50), (9, 1), (9, 0)]


def by_integration(prior: GapPrior, gaps: list[float]) -> tuple[float, float]:
    """Bayes' rule on a grid of mean gaps: slow and obvious."""
    sigma, tau = prior.token_cv * prior.mean_s, prior.plan_cv * prior.mean_s
    means = np.linspace(prior.mean_s - 12 * tau, prior.mean_s + 12 * tau, 400_001)
    log = -((means - prior.mean_s) ** 2) / (2 * tau**2)
    for gap in gaps:
        log -= (gap - means) ** 2 / (2 * sigma**2)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = float(weight @ means)
    return mean, float(weight @ (means - mean) ** 2)


@pytest.mark.parametrize("gaps", [[], [0.3], [0.1, 0.25, 0.2, 0.3], [0.2] * 40])
def test_tokens_sharpen_the_prior_as_bayes_rule_says(gaps: list[float]) -> None:
    prior = GapPrior(0.2, 0.1, 0.3)
    mean, relative = prior.learned(float(len(gaps)), sum(gaps))
    expected, variance = by_integration(prior, gaps)
    assert mean == pytest.approx(expected, rel=1e-6)
    assert relative * prior.mean_s**2 == pytest.approx(variance, rel=1e-4)


def test_where_nothing_is_known_two_gaps_tell_the_rate() -> None:
    mean, _ = VAGUE.learned(2.0, 2.0)
    assert mean == pytest.approx(1.0, rel=0.01)


def test_fitting_finds_the_spreads_that_the_plans_were_drawn_with() -> None:
    rng = np.random.default_rng(3)
    gaps = rng.lognormal(0, 0.1, 2000) * Lognormal(0.5, 0.2).sample(rng, 48, 2000)
    prior = GapPrior.fit(2 + np.cumsum(gaps, axis=0))
    assert prior.mean_s == pytest.approx(0.5 * math.exp(0.005), rel=0.01)
    assert prior.plan_cv == pytest.approx(0.1, rel=0.05)
    assert prior.token_cv == pytest.approx(0.2, rel=0.05)


def test_what_a_gap_varies_is_told_by_sums_over_about_the_square_root_of_their_number() -> None:
    gaps = np.array([0.1] * 4 + [0.3] * 4 + [0.1] * 4 + [0.3] * 4)
    token_s = np.cumsum(np.tile([0.0, *gaps], (2, 1)).T, axis=0)
    sums = np.array([0.4, 1.2, 0.4, 1.2])
    assert GapPrior.fit(token_s).token_cv == pytest.approx((sums.var(ddof=1) / 4) ** 0.5 / 0.2)


@pytest.mark.parametrize(
    ("token_s", "message"),
    [
        *((np.cumsum(np.ones(shape), axis=0), "a prior needs 2 plans of 3 tokens or more, not") for shape in SHORT),
        (np.ones((5, 5)), "all at once"),
    ],
)
def test_too_little_is_refused(token_s: np.ndarray, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        GapPrior.fit(token_s)


def test_gaps_without_any_spread_still_let_plans_teach_something() -> None:
    prior = GapPrior.fit(np.cumsum(np.ones((12, 5)), axis=0))
    assert 0 < prior.token_cv < 1e-3
    mean, _ = prior.learned(5.0, 10.0)
    assert 1.0 < mean <= 2.0


def test_the_least_that_can_be_fitted_by_hand() -> None:
    # Plan means 1 and 3, gaps (0.5, 1.5) and (2, 4): within, variances .5 and 2 of a gap; between, 2 of the means.
    prior = GapPrior.fit(np.array([[0.0, 1.0], [0.5, 3.0], [2.0, 7.0]]))
    token = (0.5 + 2) / 2 / 2**2
    assert prior.mean_s == 2
    assert prior.token_cv == pytest.approx(token**0.5)
    assert prior.plan_cv == pytest.approx((2 / 2**2 - token / 2) ** 0.5)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_a_prior_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(UsageError, match="plan_cv"):
        GapPrior(0.2, value, 0.2)
