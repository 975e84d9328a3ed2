"""Numbers of a robot as they come from outside, actions and state: checked where they enter, whatever carried them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.types import Action, Vector

NUMBERS: Final = 1 << 20
"""More than any chunk has."""


def actions_of(values: Any, first: int = 0) -> list[Action]:
    """Return the actions in an array (H, D), or in (D,) one, from tick ``first`` on.

    Raises RequestFailed for what is no such array of finite numbers, or too large: nobody moves a robot by it.
    """
    rows = _numbers("actions", values, (1, 2))
    return [Action(first + tick, row) for tick, row in enumerate(np.atleast_2d(rows))]


def state_of(values: Any) -> tuple[float, ...]:
    """Return a robot's state from a list or an array (D,), each number a float32; raises RequestFailed."""
    try:
        if not len(values):
            return ()
    except TypeError:
        raise RequestFailed("the state should be a list of numbers") from None
    return tuple(_numbers("the state", values, (1,)).tolist())


def _numbers(what: str, values: Any, dimensions: tuple[int, ...]) -> Vector:
    """Return finite float32 in an array of so many dimensions; raises RequestFailed."""
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
        found = array.astype(np.float32)
    if not np.isfinite(found).all():
        raise RequestFailed(f"{what}: not finite numbers")
    return found
