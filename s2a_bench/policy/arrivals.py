"""When fragments arrive: at a steady rate, or from random gaps between tokens."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from s2a_bench.boards.gaps import Gaps
    from s2a_bench.policy import Floats


def uniform(prompt_s: ArrayLike, tokens_per_skill: ArrayLike, tokens_per_s: ArrayLike, n_skills: int) -> Floats:
    """Return t_i = c + i L / R, shape (N, M), for c in s, L tokens with the delimiter, R in tokens/s; each (M,) or one.

    The time to first token is c + 1 / R.
    """
    gap = np.asarray(tokens_per_skill, dtype=np.float64) / np.asarray(tokens_per_s, dtype=np.float64)
    steps = np.arange(1.0, n_skills + 1)[:, np.newaxis]
    return np.asarray(prompt_s, dtype=np.float64) + steps * np.atleast_1d(gap)


def tokens(gaps: Gaps, prompt_s: ArrayLike, count: int, plans: int, rng: np.random.Generator) -> Floats:
    """Draw when each token arrives, shape (count, plans): the first one gap after ``prompt_s`` (one, or one a plan)."""
    at_s = gaps.sample(rng, count, plans)
    at_s[0] += prompt_s
    for previous, row in pairwise(at_s):  # in place along contiguous rows: faster than cumsum
        np.add(row, previous, out=row)
    return at_s


def fragments(token_s: Floats, tokens_per_skill: int) -> Floats:
    """Take the tokens that complete a skill, every ``tokens_per_skill``-th: (N L, M) -> (N, M), a view."""
    return token_s[tokens_per_skill - 1 :: tokens_per_skill]
