"""The sweep file: strict TOML, every key known, every complaint one line that names file and key."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import combinations
from pathlib import Path
from typing import Any

from s2a_bench.boards.search import search_path
from s2a_bench.errors import UsageError
from s2a_bench.sweep.grid import Setting, expand

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BOARD = "board"
"""The key that is no flag: the machine that a cell needs."""
KEYS = ("command", "repeats", "rest", "seed", "settings", "grid", "zip", "exclude")
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


def read_sweep_file(path: Path) -> SweepFile:
    """Read and expand a sweep file; raises UsageError naming the file and the key."""
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read the sweep file {path}: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path} is no TOML: {error}") from error
    for key in table:
        if key not in KEYS:
            raise UsageError(f"{path}: '{key}' is none of {', '.join(KEYS)}{like(key, KEYS)}")
    command = _typed(path, table, "command", str, "")
    if not command:
        raise UsageError(f'{path}: command: say which command to repeat, as in command = "timeline"')
    fixed, grid, zipped = (
        _typed(path, table, "settings", dict, {}),
        _axes(path, table, "grid"),
        _axes(path, table, "zip"),
    )
    _check_keys(path, {"settings": fixed, "grid": grid, "zip": zipped})
    if len({len(values) for values in zipped.values()}) > 1:
        lengths = ", ".join(f"{key} {len(values)}" for key, values in zipped.items())
        raise UsageError(f"{path}: zip: axes go side by side and need one length, but have {lengths}")
    excluded = _excludes(path, table, {**grid, **zipped})
    settings = tuple({**fixed, **point} for point in expand(grid, zipped, excluded))
    repeats, seed = _whole(path, table, "repeats", 1, 1), _whole(path, table, "seed", 0, 0)
    _check_cells(path, settings, repeats)
    rest = table.get("rest", 0)
    if isinstance(rest, bool) or not isinstance(rest, (int, float)) or not 0 <= rest < float("inf"):
        raise UsageError(f"{path}: rest: {rest!r} should be seconds, 0 or more")
    return SweepFile(path, command, repeats, float(rest), seed, settings)


def like(key: str, names: Iterable[str]) -> str:
    """Guess what was meant."""
    close = get_close_matches(key, list(names), 1)
    return f"; did you mean {close[0]}?" if close else ""


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


def _axes(path: Path, table: dict[str, Any], name: str) -> dict[str, list[Any]]:
    """Return the axes of one table: non-empty lists."""
    axes: dict[str, list[Any]] = _typed(path, table, name, dict, {})
    for key, values in axes.items():
        if not isinstance(values, list) or not values:
            raise UsageError(f"{path}: {name}.{key}: an axis is a list of values, as in {key} = [...]")
    return axes


def _excludes(path: Path, table: dict[str, Any], axes: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Return the excludes; each names axes and values that there are."""
    found: list[dict[str, Any]] = _typed(path, table, "exclude", list, [])
    for pattern in found:
        if not isinstance(pattern, dict) or not pattern:
            raise UsageError(f"{path}: exclude: write [[exclude]] and the values to leave out below it")
        for key, value in pattern.items():
            if key not in axes:
                raise UsageError(f"{path}: exclude.{key}: it is no axis{like(key, axes)}")
            for each in value if isinstance(value, list) else [value]:
                if each not in axes[key]:
                    raise UsageError(f"{path}: exclude.{key}: {each!r} is no value of that axis")
    return found


def _typed(path: Path, table: dict[str, Any], key: str, kind: type, default: Any) -> Any:
    value = table.get(key, default)
    if not isinstance(value, kind):
        words: dict[Any, str] = {str: "text", dict: f"a table, [{key}]", list: f"tables, [[{key}]]"}
        raise UsageError(f"{path}: {key}: should be {words[kind]}")
    return value


def _whole(path: Path, table: dict[str, Any], key: str, default: int, least: int) -> int:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise UsageError(f"{path}: {key}: {value!r} should be a whole number, {least} or more")
    return value
