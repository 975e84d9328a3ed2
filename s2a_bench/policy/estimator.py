"""Estimate of the gap between tokens: a prior, updated by every token of the plan.

The gaps of one plan have an unknown mean mu ~ N(mu0, tau0^2) and vary around it with variance sigma^2. After g gaps
that took ``elapsed`` together, mu is N(mu_g, v_g) with (conjugate update, e.g. Gelman et al., Bayesian Data Analysis,
3rd edition, section 2.5)

    w = tau0^2 / (sigma^2 + g tau0^2),    mu_g = mu0 + w (elapsed - g mu0),    v_g = sigma^2 w.

tau0 and sigma are relative to the mean: a slower board varies more in proportion. sigma^2 is the variance of *sums* of
gaps, per token: larger than that of single gaps where slow tokens come in bursts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeVar

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats

Number = TypeVar("Number", float, "Floats")
"""One plan's value, or an array of many plans' values."""

PLAN_CV = 0.10
"""Coefficient of variation of the mean gap from plan to plan, if nothing is known of it."""

LEAST_CV = 1e-6
"""Lower limit of estimates: with a variance of zero nothing could be learned."""


@dataclass(frozen=True, slots=True)
class GapPrior:
    """Distribution of the gaps between tokens before a plan's first token."""

    mean_s: float
    plan_cv: float
    """tau0 / mu0, the variation of the mean gap from plan to plan."""
    token_cv: float
    """sigma / mu: square root of a long sum's variance per token, over the mean."""

    def __post_init__(self) -> None:
        for name in ("mean_s", "plan_cv", "token_cv"):
            if not 0 < getattr(self, name) < float("inf"):
                raise UsageError(f"prior: {name} = {getattr(self, name):g} should be above 0 and finite")

    @staticmethod
    def fit(token_s: Floats) -> GapPrior:
        """Estimate the prior from recorded plans: token arrivals in s, shape (tokens, plans).

        sigma^2 comes from sums over blocks of about sqrt(gaps) gaps, around each plan's mean; tau0^2 is the variance of
        the plans' means beyond what sigma explains. Raises UsageError for fewer than 2 gaps a plan or 2 plans.
        """
        import numpy as np

        gaps = np.diff(token_s, axis=0)
        count, plans = gaps.shape
        if count < 2 or plans < 2:  # noqa: PLR2004 - a spread within plans and one between them
            raise UsageError(f"a prior needs 2 plans of 3 tokens or more, not {plans} of {count + 1}")
        means = gaps.mean(axis=0)
        mean = float(means.mean())
        if not mean > 0:
            raise UsageError("a prior needs tokens that arrive one after another, not all at once")
        size = min(round(count**0.5), count // 2)
        number = count // size
        blocks = gaps[: number * size].reshape(number, size, plans).sum(axis=1)
        # Unbiased within each plan, then the mean over plans: a variance per gap, relative to the mean squared.
        token = float(blocks.var(axis=0, ddof=1).mean()) / size / mean**2
        plan = float(means.var(ddof=1)) / mean**2 - token / count
        return GapPrior(mean, max(plan, LEAST_CV**2) ** 0.5, max(token, LEAST_CV**2) ** 0.5)

    def learned(self, gaps: Number, elapsed_s: Number) -> tuple[Number, Number]:
        """Return the plan's mean gap in s and its relative variance, v / mu^2, after ``gaps`` gaps in ``elapsed_s``."""
        return posterior(self.mean_s, self.plan_cv**2, self.token_cv**2, gaps, elapsed_s)


def posterior(
    mean_s: float | Floats, plan: float | Floats, token: float, gaps: Number, elapsed_s: Number
) -> tuple[Number, Number]:
    """Return mu_g and v_g / mu_g^2 for a prior of mean ``mean_s`` and relative variances tau0^2, sigma^2."""
    weight: Any = plan / (token + gaps * plan)
    return mean_s + weight * (elapsed_s - gaps * mean_s), token * weight


VAGUE: Final = GapPrior(mean_s=0.2, plan_cv=3.0, token_cv=0.2)
"""Prior without a profile: the rate is learned from the first gaps of each plan."""
