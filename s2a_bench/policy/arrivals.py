"""Arrivals of tokens and fragments, at a steady rate or with random gaps, and plans made of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from s2a_bench.boards.gaps import Gaps
from s2a_bench.policy import Floats, Plans, PlanShape


def uniform(prompt_s: ArrayLike, tokens_per_skill: ArrayLike, tokens_per_s: ArrayLike, n_skills: int) -> Floats:
    """Return t_i = c + i L / R, shape (N, M), for c in s, L tokens with the delimiter, R in tokens/s; each (M,) or one.

    The time to first token is c + 1 / R.
    """
    gap = np.asarray(tokens_per_skill, dtype=np.float64) / np.asarray(tokens_per_s, dtype=np.float64)
    steps = np.arange(1.0, n_skills + 1)[:, np.newaxis]
    return np.asarray(prompt_s, dtype=np.float64) + steps * np.atleast_1d(gap)


def tokens(gaps: Gaps, prompt_s: ArrayLike, count: int, plans: int, rng: np.random.Generator) -> Floats:
    """Draw token arrivals, shape (count, plans); the first comes one gap after ``prompt_s`` (one, or (plans,))."""
    at_s = gaps.sample(rng, count, plans)
    at_s[0] += prompt_s
    for previous, row in pairwise(at_s):  # in place along contiguous rows: faster than cumsum
        np.add(row, previous, out=row)
    return at_s


def fragments(token_s: Floats, tokens_per_skill: int) -> Floats:
    """Return the arrivals of the tokens that complete a skill: (N L, M) -> (N, M), a view."""
    return token_s[tokens_per_skill - 1 :: tokens_per_skill]


def with_skills(token_s: Floats, shape: PlanShape, rng: np.random.Generator) -> Plans:
    """Make plans of tokens, shape (N L, M); each skill's duration is drawn uniformly around the expected one."""
    half = shape.expected_cv * 3**0.5
    factor = rng.uniform(1 - half, 1 + half, (shape.n_skills, token_s.shape[1]))
    return Plans(
        arrival_s=fragments(token_s, int(shape.tokens_per_skill)),
        nominal_s=factor * shape.expected.nominal_s,
        least_s=factor * shape.expected.least_s,
        most_s=factor * shape.expected.most_s,
        token_s=token_s,
        shape=shape,
    )


def recorded_plans(recordings: Sequence[ArrayLike], shape: PlanShape, rng: np.random.Generator) -> Plans:
    """Make one plan of each recorded answer, given as its tokens' arrivals in s from the request.

    The first N L tokens are used; shorter recordings are left out. A long answer makes one plan only, because its
    segments share a rate and would not be exchangeable with further answers.
    """
    count = shape.n_skills * int(shape.tokens_per_skill)
    long_enough = [np.asarray(token_s, dtype=np.float64)[:count] for token_s in recordings if np.size(token_s) >= count]
    return with_skills(np.stack(long_enough, axis=1) if long_enough else np.empty((count, 0)), shape, rng)
