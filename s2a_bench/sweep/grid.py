"""From axes to settings: the product of the grid, the zipped axes side by side, less what is excluded. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from random import Random
from typing import Any, TypeAlias, TypeVar

Axes: TypeAlias = Mapping[str, Sequence[Any]]
Setting: TypeAlias = dict[str, Any]
Item = TypeVar("Item")


def expand(grid: Axes, zipped: Axes, excluded: Sequence[Mapping[str, Any]] = ()) -> list[Setting]:
    """List every setting: each combination of the grid with each row of the zipped axes, which are of one length.

    A setting is left out where it agrees with every key of an exclude; a list there stands for any of its values.
    """
    rows = [dict(zip(zipped, row, strict=True)) for row in zip(*zipped.values(), strict=True)] if zipped else [{}]
    whole = [dict(zip(grid, point, strict=True)) | row for point in product(*grid.values()) for row in rows]
    return [setting for setting in whole if not any(_agrees(setting, pattern) for pattern in excluded)]


def rounds(items: Sequence[Item], repeats: int, seed: int) -> Iterator[tuple[int, Item]]:
    """Yield all items once, then all again: repeats are far apart, so that a machine's drift meets all alike.

    Each round has a random order of its own, from the seed. Repeats count from 1.
    """
    for repeat in range(1, repeats + 1):
        order = list(items)
        Random(f"{seed}/{repeat}").shuffle(order)  # noqa: S311 - an order, no secret
        for item in order:
            yield repeat, item


def _agrees(setting: Setting, pattern: Mapping[str, Any]) -> bool:
    """Return whether every key of the pattern has, or lists, the setting's value."""
    return all(
        key in setting and setting[key] in (value if isinstance(value, list) else [value])
        for key, value in pattern.items()
    )
