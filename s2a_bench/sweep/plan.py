"""Turns a sweep file into cells: each setting as a command line, in the order in which they run."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from s2a_bench.boards.profile import find_profile
from s2a_bench.errors import UsageError
from s2a_bench.sweep import SweepCell, SweepCommand
from s2a_bench.sweep.file import BOARD, RESERVED, Setting, SweepFile, rounds
from s2a_bench.text import like

HASHED_WHOLE = 1 << 20
"""Bytes; a larger file that a setting names is identified by size and time, a smaller one by its content."""


@dataclass(frozen=True, slots=True)
class SweepPlan:
    command: str
    cells: tuple[SweepCell, ...]
    rest_s: float
    seed: int
    repeats: int

    @property
    def config_hash(self) -> str:
        """Identify the sweep: a changed value, axis, order or profile changes the hash."""
        return _hash([self.command, self.rest_s, self.seed, [[*cell.key, cell.config_hash] for cell in self.cells]])


def plan_sweep(file: SweepFile, command: SweepCommand, boards: Collection[str] | None = None) -> SweepPlan:
    """Make the cells for ``boards`` and those that need no board; None makes all.

    Raises UsageError, naming file and key, for an unknown flag and for a value that the command's parser refuses.
    """
    settings = list(enumerate(file.settings, 1))
    for _, setting in settings:
        _check_keys(file, command, setting)
    selected = [(number, each) for number, each in settings if boards is None or each.get(BOARD, "") in {"", *boards}]
    if not selected:
        wanted = ", ".join(dict.fromkeys(str(setting[BOARD]) for _, setting in settings))
        raise UsageError(f"`board`: {file.path} has cells for {wanted} only; name one of them, or use `ray`")
    cells = []
    for repeat, (number, setting) in rounds(selected, file.repeats, file.seed):
        argv = _argv(file, command, setting, file.seed + repeat - 1)
        try:
            virtual = command.check(argv[1:])
        except UsageError as error:
            label = " ".join(f"{key}={value}" for key, value in setting.items())
            raise UsageError(f"{file.path}: {label}: {error}") from error
        config_hash = _hash([argv, setting.get(BOARD), [_content(path) for path in _files(setting)]])
        plain = {key: _text(value) if isinstance(value, list) else value for key, value in setting.items()}
        cells.append(SweepCell(number, repeat, plain, tuple(argv), virtual, setting.get(BOARD, ""), config_hash))
    return SweepPlan(command.name, tuple(cells), file.rest_s, file.seed, file.repeats)


def _check_keys(file: SweepFile, command: SweepCommand, setting: Setting) -> None:
    for key, value in setting.items():
        if key == BOARD:
            if not isinstance(value, str) or not value:
                raise UsageError(f"{file.path}: board: {value!r} should be the name of a machine")
            continue
        if key not in command.flags:
            shown = {name for name, kind in command.flags.items() if kind != "hidden"}
            keys = sorted({*shown, BOARD}.difference(RESERVED))
            hint = like(key, keys) or f"; it has {', '.join(keys)}"
            raise UsageError(f"{file.path}: '{key}' is not a flag of s2a-bench {command.name}{hint}")
        if command.flags[key] in {"switch", "toggle"}:
            if not isinstance(value, bool):
                raise UsageError(f"{file.path}: {key}: {value!r} should be true or false")
        else:
            for each in value if isinstance(value, list) else [value]:
                if isinstance(each, bool) or not isinstance(each, (str, int, float)):
                    raise UsageError(f"{file.path}: {key}: {each!r} should be text or a number")


def _argv(file: SweepFile, command: SweepCommand, setting: Setting, seed: int) -> list[str]:
    """Return a setting as a command line; a list becomes one value with commas."""
    flags, arguments = [], []
    for key, value in setting.items():
        if key == BOARD:
            continue
        text = _text(value)
        if command.flags[key] == "argument":
            arguments.append(text)
        elif command.flags[key] in {"value", "hidden"}:
            flags.append(f"--{key}={text}")
        elif value:
            flags.append(f"--{key}")
        elif command.flags[key] == "toggle":
            flags.append(f"--no-{key}")
    if "seed" in command.flags:
        flags.append(f"--seed={seed}")
    if "data-only" in command.flags:
        flags.append("--data-only")
    return [file.command, *arguments, *flags]


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _files(setting: Setting) -> Iterator[Path]:
    """Yield the files that settings name, also profiles by name: their content is part of the configuration."""
    for key, value in setting.items():
        for text in map(str.strip, _text(value).split(",")):
            path = Path(text.removeprefix("@").rpartition(":")[2])  # of PATH, @PATH or video:PATH
            with suppress(OSError):  # too long for a path: a prompt
                if key == "profile" and text:
                    yield find_profile(text)
                elif path.is_file():
                    yield path


def _content(path: Path) -> list[Any]:
    facts = path.stat()
    if facts.st_size <= HASHED_WHOLE:
        return [path.name, sha256(path.read_bytes()).hexdigest()]
    return [path.name, facts.st_size, facts.st_mtime_ns]


def _hash(value: Any) -> str:
    return sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
