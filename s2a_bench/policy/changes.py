"""Detect changes of the machine's rate within a plan; the estimate of `estimator` starts anew at a change.

After every token the last h = 1..WINDOW gaps are compared with the forecast from the gaps before them, in standard
deviations

    z_h = (their sum - h mu) / (mu sqrt(h sigma^2 + h^2 v)),

with mu and v learned from the tokens before the window. If the largest z_h exceeds SURPRISE, the machine has slowed
down: the plan's rate is learned anew from that window on, with a vague prior (plan CV FRESH_CV). If a slow plan's least
z_h is below -SURPRISE, the rate has recovered and all tokens count again. Gaps shorter than expected do not count: it
would be risky to start on a few of them. This is the generalised likelihood ratio of a change in mean over a sliding
window (Willsky and Jones, IEEE TAC 1976). sigma is that of *sums* of gaps: where slow tokens usually come in bursts, a
burst is not a change.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from s2a_bench.policy import Floats
from s2a_bench.policy.estimator import GapPrior, posterior

WINDOW: Final = 8
SURPRISE: Final = 4.0
FRESH_CV: Final = 1.0


class ChangeWatch:
    """Change detection on M plans in parallel, one token of each at a time."""

    def __init__(self, prior: GapPrior, plans: int = 1) -> None:
        self._prior = prior
        self._token = prior.token_cv**2
        self._prior_s = np.full(plans, prior.mean_s)
        self._plan = np.full(plans, prior.plan_cv**2)
        self._recent_s = np.full((WINDOW + 1, plans), np.nan)
        self._tokens = 0
        self._began_s = self._first_s = np.zeros(plans)
        self._gaps = np.zeros(plans)
        self.slow = np.zeros(plans, dtype=np.bool_)
        """Whether each plan has slowed down and not recovered."""

    def token(self, at_s: ArrayLike) -> None:
        """Record the arrival of the next token: one time, or shape (M,)."""
        at_s = np.atleast_1d(np.asarray(at_s, dtype=np.float64))
        self._recent_s[1:] = self._recent_s[:-1].copy()
        self._recent_s[0] = at_s
        self._tokens += 1
        if self._tokens == 1:
            self._began_s = self._first_s = at_s.copy()
            return
        self._gaps += 1
        size = np.arange(1.0, WINDOW + 1)[:, np.newaxis]
        inside = size <= self._gaps
        begin_s = np.where(inside, self._recent_s[1:], at_s)
        before = np.maximum(self._gaps - size, 0.0)
        elapsed_s = np.where(inside, begin_s - self._first_s, 0.0)
        mean_s, variance = posterior(self._prior_s, self._plan, self._token, before, elapsed_s)
        surprise = (at_s - begin_s - size * mean_s) / (mean_s * np.sqrt(size * self._token + size**2 * variance))
        surprise = np.where(inside, surprise, 0.0)
        worst, plans = surprise.argmax(axis=0), np.arange(at_s.size)
        slower = surprise[worst, plans] > SURPRISE
        again = self.slow & ~slower & (surprise.min(axis=0) < -SURPRISE)
        if slower.any() or again.any():
            self.slow = (self.slow | slower) & ~again

            def changed(now: Floats | float, at_change: Floats, at_first: Floats | float) -> Floats:
                return np.where(slower, at_change, np.where(again, at_first, now))

            self._prior_s = changed(self._prior_s, mean_s[worst, plans], self._prior.mean_s)
            self._plan = changed(self._plan, np.full(at_s.shape, FRESH_CV**2), self._prior.plan_cv**2)
            self._first_s = changed(self._first_s, begin_s[worst, plans], self._began_s)
            self._gaps = changed(self._gaps, worst + 1.0, self._tokens - 1.0)

    @property
    def learned(self) -> tuple[Floats, Floats]:
        elapsed_s = self._recent_s[0] - self._first_s if self._tokens else self._first_s
        return posterior(self._prior_s, self._plan, self._token, self._gaps, elapsed_s)


def learned_along(prior: GapPrior, token_s: Floats) -> tuple[Floats, Floats]:
    """Return `GapPrior.learned` after each token: two arrays of the shape of ``token_s``, (tokens, M)."""
    watch = ChangeWatch(prior, token_s.shape[1])
    mean_s, variance = np.empty((2, *token_s.shape))
    for row, at_s in enumerate(token_s):
        watch.token(at_s)
        mean_s[row], variance[row] = watch.learned
    return mean_s, variance
