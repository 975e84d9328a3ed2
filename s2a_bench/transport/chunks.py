"""Chunks of actions as they come from outside: checked where they enter, whatever carried them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.types import Action

NUMBERS: Final = 1 << 20
"""More than any chunk has."""


def actions_of(values: Any, first: int = 0) -> list[Action]:
    """Return the actions in an array (H, D), or in (D,) one, from tick ``first`` on.

    Raises RequestFailed for what is no such array of finite numbers, or too large: nobody moves a robot by it.
    """
    try:
        array = np.asarray(values)
    except (ValueError, OverflowError) as error:
        raise RequestFailed(f"actions that are no array: {error}") from error
    if array.ndim not in {1, 2} or not array.size or array.dtype.kind not in "fiu":
        raise RequestFailed(f"actions of shape {array.shape} and type {array.dtype}, not numbers of shape (H, D)")
    if array.size > NUMBERS:
        raise RequestFailed(f"a chunk of {array.size} numbers; at most {NUMBERS} are taken")
    with np.errstate(over="ignore"):
        rows = np.atleast_2d(array).astype(np.float32)
    if not np.isfinite(rows).all():
        raise RequestFailed("actions that are not finite numbers")
    return [Action(first + tick, row) for tick, row in enumerate(rows)]
