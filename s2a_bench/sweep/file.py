"""The sweep file: strict TOML, whose errors name file and key; its settings and the order of its rounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from random import Random
from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import Field

from s2a_bench.boards.profile import search_path, toml_files
from s2a_bench.errors import UsageError
from s2a_bench.text import like, none_of
from s2a_bench.toml_file import TomlTable, parse, read

Axes: TypeAlias = Mapping[str, Sequence[Any]]
Setting: TypeAlias = dict[str, Any]
Item = TypeVar("Item")


def expand(grid: Axes, zipped: Axes, excluded: Sequence[Mapping[str, Any]] = ()) -> list[Setting]:
    """Return every setting: each combination of the grid with each row of the zipped axes, which have one length.

    A setting is left out if it agrees with every key of an exclude, where a list stands for any of its values.
    """

    def agrees(setting: Setting, pattern: Mapping[str, Any]) -> bool:
        return all(key in setting and setting[key] in _listed(value) for key, value in pattern.items())

    rows = [dict(zip(zipped, row, strict=True)) for row in zip(*zipped.values(), strict=True)] if zipped else [{}]
    whole = [dict(zip(grid, point, strict=True)) | row for point in product(*grid.values()) for row in rows]
    return [setting for setting in whole if not any(agrees(setting, each) for each in excluded)]


def rounds(items: Sequence[Item], repeats: int, seed: int) -> Iterator[tuple[int, Item]]:
    """Yield repeat, from 1, and item: all items once, then all again, so that a machine's drift meets all of them.

    Each round has its own random order, from the seed.
    """
    for repeat in range(1, repeats + 1):
        order = list(items)
        Random(f"{seed}/{repeat}").shuffle(order)  # noqa: S311 - an order, not a secret
        for item in order:
            yield repeat, item


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


BOARD = "board"
"""The one key that is not a flag: the machine that a cell needs."""
Axis = Annotated[list[Any], Field(min_length=1)]
RESERVED = {
    "seed": "the seed is a key at the top of the file; every repeat derives its own from it",
    "output": "--output of 's2a-bench sweep' names the folder of all cells",
    "json": "the sweep has --json itself",
    "data-only": "cells always keep data only",
    "help": "it is not a setting",
    "help-all": "it is not a setting",
}
"""Flags that a sweep sets itself -> what to do instead."""
MOST_CELLS = 100_000


@dataclass(frozen=True, slots=True)
class SweepFile:
    """A sweep file; its settings are not checked by the command yet."""

    path: Path
    command: str
    repeats: int
    rest_s: float
    """Pause between measured cells, in which the board cools down."""
    seed: int
    settings: tuple[Setting, ...]


def sweep_files() -> dict[str, Path]:
    return toml_files([folder / "sweeps" for folder in search_path()])


def find_sweep(name: str) -> Path:
    """Return the path of a sweep file, given as a path or as a name; raises UsageError for an unknown name."""
    if "/" in name or name.endswith(".toml"):
        return Path(name)
    files = sweep_files()
    if name not in files:
        raise UsageError(none_of(name, files, ", and no path of a sweep file"))
    return files[name]


class _SweepFile(TomlTable):
    command: str
    repeats: int = Field(1, ge=1)
    rest: float = Field(0.0, ge=0)
    seed: int = Field(0, ge=0)
    settings: dict[str, Any] = Field({})
    grid: dict[str, Axis] = Field({})
    zip: dict[str, Axis] = Field({})
    exclude: list[Annotated[dict[str, Any], Field(min_length=1)]] = Field([])


def read_sweep_file(path: Path) -> SweepFile:
    """Read and expand a sweep file; raises UsageError naming the file and the key."""
    file = parse(_SweepFile, read(path, "file"), str(path))
    _check_keys(path, {"settings": file.settings, "grid": file.grid, "zip": file.zip})
    if len({len(values) for values in file.zip.values()}) > 1:
        lengths = ", ".join(f"{key} {len(values)}" for key, values in file.zip.items())
        raise UsageError(f"{path}: zip: axes go side by side and need one length, but have {lengths}")
    _check_excludes(path, file.exclude, {**file.grid, **file.zip})
    settings = tuple({**file.settings, **point} for point in expand(file.grid, file.zip, file.exclude))
    _check_cells(path, settings, file.repeats)
    return SweepFile(path, file.command, file.repeats, file.rest, file.seed, settings)


def _check_keys(path: Path, tables: dict[str, dict[str, Any]]) -> None:
    for (one, keys), (other, others) in combinations(tables.items(), 2):
        for key in keys:
            if key in others:
                raise UsageError(f"{path}: '{key}' is in [{one}] and in [{other}]; keep one of them")
    for name, keys in tables.items():
        for key in keys:
            if key in RESERVED:
                raise UsageError(f"{path}: {name}.{key}: {RESERVED[key]}")


def _check_cells(path: Path, settings: tuple[Setting, ...], repeats: int) -> None:
    if not settings:
        raise UsageError(f"{path}: exclude: no cell is left; remove an exclude")
    if len(settings) * repeats > MOST_CELLS:
        raise UsageError(f"{path}: {len(settings) * repeats} cells are more than {MOST_CELLS}; shorten an axis")
    if len({repr(sorted(setting.items())) for setting in settings}) < len(settings):
        raise UsageError(f"{path}: an axis has a value twice; use repeats to measure again")


def _check_excludes(path: Path, excluded: list[dict[str, Any]], axes: dict[str, list[Any]]) -> None:
    for pattern in excluded:
        for key, value in pattern.items():
            if key not in axes:
                raise UsageError(f"{path}: exclude.{key}: it is not an axis{like(key, axes)}")
            for each in _listed(value):
                if each not in axes[key]:
                    raise UsageError(f"{path}: exclude.{key}: {each!r} is not a value of that axis")
