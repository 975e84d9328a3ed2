"""Actions and robot state from outside, from a peer or a user's function, checked where they enter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.types import Action, Vector

NUMBERS: Final = 1 << 20
"""More than any chunk has."""
BATCHED: Final = 3
"""Axes of a batch of chunks, of which one chunk is taken."""


def actions_of(values: Any, first: int = 0) -> list[Action]:
    """Return the actions of an array (H, D) or (1, H, D), or the one of (D,), counted from tick ``first``.

    A map of arrays has the parts of each action, which are put side by side in the map's order; those whose names
    begin with ``action`` if there are any. Raises RequestFailed unless the values are finite numbers of that shape:
    they may move a robot.
    """
    rows = _side_by_side(values) if isinstance(values, Mapping) else _numbers("actions", values, (1, 2))
    return [Action(first + tick, row) for tick, row in enumerate(np.atleast_2d(rows))]


def _side_by_side(parts: Mapping[Any, Any]) -> Vector:
    named = {name: part for name, part in parts.items() if str(name).startswith("action")} or parts
    rows = [_numbers(f"action '{str(name)[:40]}'", part, (1, 2)) for name, part in named.items()]
    if len({len(part) for part in rows}) != 1:
        shapes = ", ".join(f"{str(name)[:40]} {part.shape}" for name, part in zip(named, rows, strict=True))
        raise RequestFailed(f"parts of actions that are of one length: there are {shapes or 'none'}")
    return np.concatenate([part.reshape(len(part), -1) for part in rows], axis=1)


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
        raise RequestFailed(f"{what}: not an array of numbers: {error}") from error
    if array.ndim == BATCHED and len(array) == 1:
        array = array[0]
    if array.ndim not in dimensions or not array.size or array.dtype.kind not in "fiu":
        shape = "(H, D)" if max(dimensions) > 1 else "(D,)"
        raise RequestFailed(f"{what}: shape {array.shape} and type {array.dtype}, not numbers of shape {shape}")
    if array.size > NUMBERS:
        raise RequestFailed(f"{what}: {array.size} numbers; at most {NUMBERS} are taken")
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinite, which is refused below
        vector = array.astype(np.float32)
    if not np.isfinite(vector).all():
        raise RequestFailed(f"{what}: not finite numbers")
    return vector
