"""Tables of a run folder: rows of a dataclass, whose fields are the columns, and columns derived from them.

Every experiment declares its own tables. The annotations of rows and of the cells of ``--json`` have the bounds of
numbers; docs/schema is generated from them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from types import NoneType
from typing import Any, Final, Generic, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

from s2a_bench.bounds import Count, Facts, Fraction, Many, NonNegative, Positive, about
from s2a_bench.secrets import struck

__all__ = ["PROVENANCE", "SCHEMA", "Count", "Facts", "Fraction", "Many", "NonNegative", "Positive", "about"]

SCHEMA: Final = "s2a-bench/1"
"""The version of folder, columns and ``--json``; it changes if a column changes its meaning or is removed."""

Kind: TypeAlias = Literal["string", "json", "category", "int64", "float64", "bool"]
"""Of a column: JSON is another text in most rows; a category is a text that many rows share."""

Value: TypeAlias = str | int | float | bool | None

PROVENANCE: Final = "provenance"
"""The last column of every table: a code of the origin of a row's numbers."""

Row = TypeVar("Row")


@dataclass(frozen=True, eq=False)
class Table(Generic[Row]):
    """One table: the dataclass of its rows, and the columns derived from a row."""

    name: str
    row: type[Row]
    derived: dict[str, Kind] = field(default_factory=dict)
    derive: Callable[[Row], dict[str, Value]] | None = None

    @cached_property
    def columns(self) -> dict[str, Kind]:
        """The columns in order: the row's fields, the derived ones, the provenance."""
        hints = get_type_hints(self.row)
        return {name: _kind(hints[name]) for name in self._fields} | self.derived | {PROVENANCE: "string"}

    @cached_property
    def _fields(self) -> tuple[str, ...]:
        return tuple(item.name for item in fields(self.row) if item.name != PROVENANCE)  # type: ignore[arg-type]  # a row is a dataclass

    def values(self, row: Row, provenance: str = "") -> Iterator[Value]:
        """Yield one value a column; lists and dicts become JSON text."""
        for name in self._fields:
            yield _stored(getattr(row, name))
        derived = self.derive(row) if self.derive else {}
        for name in self.derived:
            yield _stored(derived.get(name))
        yield provenance


INT64: Final = range(-(1 << 63), 1 << 63)


def _stored(value: Any) -> Value:
    if isinstance(value, (list, dict)):
        return json.dumps(_sound(value), separators=(",", ":"), ensure_ascii=False)
    return _sound(value)  # type: ignore[no-any-return]


def _sound(value: Any) -> Any:
    """Strike out secrets, and replace numbers that no reader accepts by null: NaN, integers of more than 64 bits."""
    if isinstance(value, dict):
        return {name: _sound(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_sound(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, int) and not isinstance(value, bool):
        return value if value in INT64 else None
    return struck(value, short=False) if isinstance(value, str) else value


def _kind(hint: Any) -> Kind:
    """Return the column type of an annotation: JSON of a list or dict, text unless it is a plain number or a bool."""
    plain = next((arg for arg in get_args(hint) if arg is not NoneType), hint) if NoneType in get_args(hint) else hint
    kinds: dict[Any, Kind] = {int: "int64", float: "float64", bool: "bool", list: "json", dict: "json"}
    return kinds.get(get_origin(plain) or plain, "string")
