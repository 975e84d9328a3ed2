"""How values of flags that several commands share are read: lists, sizes, texts and files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.cli.adapter import flags_named
from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from s2a_bench.inference import EngineConfig

WIDTH = 100
"""Columns of the tables where the output is no terminal."""


def listed(text: str) -> tuple[str, ...]:
    """Split at commas, each name once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def numbers(flag: str, text: str) -> tuple[float, ...]:
    """Read numbers between commas, each once; raises UsageError naming the flag."""
    try:
        return tuple(float(part) for part in listed(text))
    except ValueError as error:
        raise UsageError(f"{flag}: '{text}' should be numbers with commas between them") from error


def whole_numbers(flag: str, text: str) -> tuple[int, ...]:
    """Read whole numbers between commas, each once; raises UsageError naming the flag."""
    try:
        return tuple(int(part) for part in listed(text))
    except ValueError as error:
        raise UsageError(f"{flag}: '{text}' should be whole numbers with commas between them") from error


def size_of(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise UsageError(f"--size: '{text}' should look like 640x480")
    return int(width), int(height)


def text_or_file(value: str, flag: str = "--prompt") -> str:
    """Return a text, or the content of the file that ``@FILE`` names."""
    return file_text(Path(value[1:]), flag) if value.startswith("@") else value


def file_text(path: Path, flag: str) -> str:
    """Read a text file that a flag names."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{flag}: cannot read {path}: {error}") from error


def engine_config(**given: Any) -> EngineConfig:
    """Make the engine's options of a command that declares their flags itself; raises UsageError naming the flag."""
    from s2a_bench.inference import EngineConfig

    with flags_named(EngineConfig):
        return EngineConfig(**given)
