"""Actions and robot state from outside, checked where they enter, for every transport."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.types import Action, Vector

NUMBERS: Final = 1 << 20
"""More than any chunk has."""


def actions_of(values: Any, first: int = 0) -> list[Action]:
    """Return the actions of an array (H, D), or the one of (D,), counted from tick ``first``.

    Raises RequestFailed unless the values are finite numbers of that shape: they may move a robot.
    """
    rows = _numbers("actions", values, (1, 2))
    return [Action(first + tick, row) for tick, row in enumerate(np.atleast_2d(rows))]


def state_of(values: Any) -> tuple[float, ...]:
    """Return a robot's state from a list or an array (D,), rounded to float32; raises RequestFailed."""
    try:
        if not len(values):
            return ()
    except TypeError:
        raise RequestFailed("the state should be a list of numbers") from None
    return tuple(_numbers("the state", values, (1,)).tolist())


def _numbers(what: str, values: Any, dimensions: tuple[int, ...]) -> Vector:
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:
        raise RequestFailed(f"{what}: no array of numbers: {error}") from error
    if array.ndim not in dimensions or not array.size or array.dtype.kind not in "fiu":
        shape = "(H, D)" if max(dimensions) > 1 else "(D,)"
        raise RequestFailed(f"{what}: shape {array.shape} and type {array.dtype}, not numbers of shape {shape}")
    if array.size > NUMBERS:
        raise RequestFailed(f"{what}: {array.size} numbers; at most {NUMBERS} are taken")
    with np.errstate(over="ignore"):
        vector = array.astype(np.float32)
    if not np.isfinite(vector).all():
        raise RequestFailed(f"{what}: not finite numbers")
    return vector
