"""The file of a hardware profile: TOML text to `Profile`, strictly, and back.

Every value is checked where it is read, and an error names the file and the key: a typing error must not become a
rate that figures show.
"""

from __future__ import annotations

import json
import math
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from s2a_bench.boards.gaps import from_table
from s2a_bench.boards.profile import Profile
from s2a_bench.errors import UsageError

FACTS = ("board", "model", "capture", "fit", "environment", "source")
"""Tables for people and for `profile match`; what is in them is free."""

ORIGINS = ("paper", "measured")
_LARGEST = 1e9
_RATE_TOLERANCE = 0.01
_LINE = 110
_REQUIRED = ("title", "origin", "tokens_per_s", "prompt_s", "gaps")


def parse_profile(name: str, text: str, where: str) -> Profile:
    """Read a profile; ``where`` begins every error. Raises UsageError naming the key that is wrong."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{where}: no TOML: {error}") from error
    try:
        return _profile(name, document)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def _profile(name: str, document: Mapping[str, Any]) -> Profile:
    for key in document:
        if key not in _READERS and key not in FACTS:
            raise UsageError(f"{key}: a profile has no such key; it has {', '.join((*_READERS, *FACTS))}")
    for key in _REQUIRED:
        if key not in document:
            raise UsageError(f"{key}: missing")
    for key in FACTS:
        if not isinstance(document.get(key, {}), dict):
            raise UsageError(f"{key}: should be a table")
        _check_fact(key, document.get(key))
    values = {"prompt_cv": 0.0} | {key: read(key, document[key]) for key, read in _READERS.items() if key in document}
    table = values.pop("gaps")
    try:
        values["gaps"] = from_table(table, 1 / values["tokens_per_s"])
    except UsageError as error:
        raise UsageError(f"gaps.{error}") from error
    values["trace_s"] = trace = values.pop("trace", ())
    if trace:
        rate = len(trace) / math.fsum(trace)
        if abs(rate / values["tokens_per_s"] - 1) > _RATE_TOLERANCE:
            raise UsageError(
                f"tokens_per_s: {values['tokens_per_s']:g}, but the gaps of [trace] make {rate:g}; correct one of them"
            )
    facts = {key: document[key] for key in FACTS if key in document}
    return Profile(name=name, facts=facts, **values)


def _check_fact(key: str, value: object) -> None:
    """Refuse numbers that JSON cannot say, wherever they are."""
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{key}: {value} should be finite")
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_fact(f"{key}.{name}", inner)
    if isinstance(value, list):
        for inner in value:
            _check_fact(key, inner)


def _text(key: str, value: object) -> str:
    if not isinstance(value, str) or not value.strip():
        raise UsageError(f"{key}: {value!r} should be a text")
    return value


def _origin(key: str, value: object) -> str:
    if value not in ORIGINS:
        raise UsageError(f"{key}: {value!r} is none of {', '.join(ORIGINS)}")
    return str(value)


def _number(key: str, value: object) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise UsageError(f"{key}: {value!r} should be a number")
    if not 0 <= value <= _LARGEST:
        raise UsageError(f"{key}: {value!r} should be between 0 and {_LARGEST:g}")
    return float(value)


def _rate(key: str, value: object) -> float:
    if not _number(key, value):
        raise UsageError(f"{key}: should be above 0")
    return _number(key, value)


def _assumed(key: str, value: object) -> tuple[str, ...]:
    names = [name for name in _READERS if name not in {"assumed", "origin", "title"}]
    if not isinstance(value, list):
        raise UsageError(f"{key}: should be a list of keys of this file")
    for item in value:
        if item not in names:
            raise UsageError(f"{key}: {item!r} is none of {', '.join(names)}")
    return tuple(value)


def _table(key: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UsageError(f"{key}: should be a table")
    return value


def _trace(key: str, value: object) -> tuple[float, ...]:
    """Return the gaps of the requests that count, one after the other, in s."""
    table = _table(key, value)
    for name in table:
        if name not in {"warmups", "ttft_ns", "gaps_ns"}:
            raise UsageError(f"{key}.{name}: a trace has no such key; it has warmups, ttft_ns, gaps_ns")
    warmups, rows, ttft = table.get("warmups", 0), table.get("gaps_ns"), table.get("ttft_ns")
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise UsageError(f"{key}.gaps_ns: should be a list of gaps for every request")
    if not all(_is_count(gap) for row in rows for gap in row):
        raise UsageError(f"{key}.gaps_ns: should hold whole numbers of ns, none negative")
    if ttft is not None and not (isinstance(ttft, list) and len(ttft) == len(rows) and all(map(_is_count, ttft))):
        raise UsageError(f"{key}.ttft_ns: should hold a whole number of ns for each of the {len(rows)} requests")
    if not _is_count(warmups) or not any(gap for row in rows[warmups:] for gap in row):
        raise UsageError(f"{key}.warmups: {warmups!r} of {len(rows)} requests leave no gaps")
    return tuple(gap / 1e9 for gap in chain.from_iterable(rows[warmups:]))


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


_READERS: dict[str, Callable[[str, object], Any]] = {
    "title": _text,
    "origin": _origin,
    "tokens_per_s": _rate,
    "prompt_s": _number,
    "prompt_cv": _number,
    "rate_cv": _number,
    "assumed": _assumed,
    "gaps": _table,
    "trace": _trace,
}
"""Key of the file -> what reads it."""


def read_profile(path: Path, name: str = "") -> Profile:
    """Read a file; the profile's name is the file's unless given. Raises UsageError naming file and key."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"profile {path}: cannot be read: {error}") from error
    return parse_profile(name or path.stem, text, f"profile {path}")


def to_toml(document: Mapping[str, Any]) -> str:
    """Write nested tables of texts, numbers, booleans and lists as TOML 1.0; None is left out."""
    return "\n".join(_lines(document, ())) + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    """Write a table's own values, then its tables, as TOML wants them."""
    lines = [f"{_key(key)} = {_value(value)}" for key, value in table.items() if not isinstance(value, dict | None)]
    for key, value in table.items():
        if isinstance(value, dict):
            inside = (*path, _key(key))
            lines += ["", f"[{'.'.join(inside)}]", *_lines(value, inside)]
    return lines


def _key(key: str) -> str:
    bare = key.isascii() and key.replace("-", "").replace("_", "").isalnum()
    return key if bare else _value(key)


def _value(value: object) -> str:
    """Write one value."""
    if isinstance(value, str):  # a JSON text is a TOML text, but for DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return _list(value)
    if isinstance(value, dict):  # inside a list
        return "{" + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, int | float):
        return repr(value)
    raise TypeError(f"{type(value).__name__} has no place in a profile")


def _list(values: Sequence[object]) -> str:
    """Write a list; a long one goes over several lines, but for the gaps of a request."""
    items = [_value(item) for item in values]
    short = f"[{', '.join(items)}]"
    if len(short) <= _LINE or all(isinstance(item, int) for item in values):
        return short
    if all(isinstance(item, float) for item in values):
        return f"[\n{textwrap.fill(', '.join(items), _LINE, initial_indent='    ', subsequent_indent='    ')},\n]"
    return "[\n" + "".join(f"    {item},\n" for item in items) + "]"
