"""The sweep file: strict TOML, every key known, every complaint one line that names file and key."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from s2a_bench.boards.search import search_path
from s2a_bench.errors import UsageError
from s2a_bench.sweep.grid import Setting, expand
from s2a_bench.toml_file import TomlTable, like, parse

BOARD = "board"
"""The key that is no flag: the machine that a cell needs."""
Axis = Annotated[list[Any], Field(min_length=1)]
OWN = {
    "seed": "the seed stands at the top of the file; every repeat has its own from it",
    "output": "--output of 's2a-bench sweep' names the folder of everything",
    "json": "the sweep has --json itself",
    "data-only": "cells keep data only, always",
    "help": "it is no setting",
}
"""Flags that a sweep sets itself, and what to do instead."""
MOST_CELLS = 100_000


@dataclass(frozen=True, slots=True)
class SweepFile:
    """What a sweep file says, before a command has looked at its settings."""

    path: Path
    command: str
    repeats: int
    rest_s: float
    """Between the cells that are measured, so that the board cools down."""
    seed: int
    settings: tuple[Setting, ...]
    """The fixed settings and those of the axes together, one each cell."""


def find_sweep(name: str) -> Path:
    """Return a sweep file given as a path, or by a name in ./profiles/sweeps, the user's folder or the package."""
    if "/" in name or name.endswith(".toml"):
        return Path(name)
    folders = [folder / "sweeps" for folder in search_path()]
    files = {path.stem: path for folder in reversed(folders) for path in sorted(folder.glob("*.toml"))}
    if name not in files:
        raise UsageError(f"'{name}' is none of {', '.join(sorted(files))}, and no path of a sweep file")
    return files[name]


class _File(TomlTable):
    """What the file may hold."""

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
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read the sweep file {path}: {error}") from error
    file = parse(_File, text, str(path))
    _check_keys(path, {"settings": file.settings, "grid": file.grid, "zip": file.zip})
    if len({len(values) for values in file.zip.values()}) > 1:
        lengths = ", ".join(f"{key} {len(values)}" for key, values in file.zip.items())
        raise UsageError(f"{path}: zip: axes go side by side and need one length, but have {lengths}")
    _check_excludes(path, file.exclude, {**file.grid, **file.zip})
    settings = tuple({**file.settings, **point} for point in expand(file.grid, file.zip, file.exclude))
    _check_cells(path, settings, file.repeats)
    return SweepFile(path, file.command, file.repeats, file.rest, file.seed, settings)


def _check_keys(path: Path, tables: dict[str, dict[str, Any]]) -> None:
    """Refuse what stands in two tables, and flags that a sweep sets itself."""
    for (one, keys), (other, others) in combinations(tables.items(), 2):
        for key in keys:
            if key in others:
                raise UsageError(f"{path}: '{key}' stands in [{one}] and in [{other}]; keep one of them")
    for name, keys in tables.items():
        for key in keys:
            if key in OWN:
                raise UsageError(f"{path}: {name}.{key}: {OWN[key]}")


def _check_cells(path: Path, settings: tuple[Setting, ...], repeats: int) -> None:
    """Refuse none, too many, and the same one twice."""
    if not settings:
        raise UsageError(f"{path}: exclude: nothing is left; take one of them out")
    if len(settings) * repeats > MOST_CELLS:
        raise UsageError(f"{path}: {len(settings) * repeats} cells are more than {MOST_CELLS}; shorten an axis")
    if len({repr(sorted(setting.items())) for setting in settings}) < len(settings):
        raise UsageError(f"{path}: an axis has a value twice; use repeats to measure again")


def _check_excludes(path: Path, excluded: list[dict[str, Any]], axes: dict[str, list[Any]]) -> None:
    """Refuse what names no axis, or no value of one."""
    for pattern in excluded:
        for key, value in pattern.items():
            if key not in axes:
                raise UsageError(f"{path}: exclude.{key}: it is no axis{like(key, axes)}")
            for each in value if isinstance(value, list) else [value]:
                if each not in axes[key]:
                    raise UsageError(f"{path}: exclude.{key}: {each!r} is no value of that axis")
