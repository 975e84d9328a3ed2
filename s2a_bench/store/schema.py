"""What a table of a run folder is: rows of a dataclass, whose fields are the columns, and columns derived from them.

Who measures declares its own tables, beside what it measures; nothing here knows any of them. Between what numbers lie
stands in the annotations of rows and of the cells of ``--json``; docs/schema follows from that.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, make_dataclass
from functools import cached_property
from types import NoneType
from typing import Annotated, Any, Final, Generic, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

from s2a_bench.secrets import struck

SCHEMA: Final = "s2a-bench/1"
"""The version of folder, columns and ``--json``; it changes when a column changes its meaning or goes."""

Kind: TypeAlias = Literal["string", "int64", "float64", "bool"]
"""What a column holds, by its Arrow name."""

Value: TypeAlias = str | int | float | bool | None
"""One field as stored; None is null."""


PROVENANCE: Final = "provenance"
"""The last column of every table: where a row's numbers come from, in one word."""

Row = TypeVar("Row")
"""The dataclass of a table's rows."""


def _nothing(_row: object) -> dict[str, Value]:
    return {}


@dataclass(frozen=True, eq=False)
class Table(Generic[Row]):
    """One file of a run folder: its rows' dataclass, and the columns that are derived from a row."""

    name: str
    row: type[Row]
    derived: dict[str, Kind] = field(default_factory=dict)
    derive: Callable[[Row], dict[str, Value]] = _nothing

    @cached_property
    def columns(self) -> dict[str, Kind]:
        """Return the columns in order: the row's fields, the derived ones, then where the numbers come from."""
        hints = get_type_hints(self.row)
        return {name: _kind(hints[name]) for name in self._own} | self.derived | {PROVENANCE: "string"}

    @cached_property
    def _own(self) -> tuple[str, ...]:
        return tuple(item.name for item in fields(self.row) if item.name != PROVENANCE)  # type: ignore[arg-type]  # a row is a dataclass

    def values(self, row: Row, provenance: str = "") -> Iterator[Value]:
        """Yield one value a column, the row's own fields first; lists and dicts become JSON text."""
        for name in self._own:
            yield _stored(getattr(row, name))
        derived = self.derive(row)
        for name in self.derived:
            yield _stored(derived.get(name))
        yield provenance


INT64: Final = range(-(1 << 63), 1 << 63)


def _stored(value: Any) -> Value:
    if isinstance(value, (list, dict)):
        return json.dumps(_sound(value), separators=(",", ":"), ensure_ascii=False)
    return _sound(value)  # type: ignore[no-any-return]


def _sound(value: Any) -> Any:
    """Strike out secrets, and make null of numbers that no reader takes: NaN, whole ones of more than 64 bits."""
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
    """Name the column type of an annotation; whatever is no plain number travels as text."""
    plain = next((arg for arg in get_args(hint) if arg is not NoneType), hint) if NoneType in get_args(hint) else hint
    kinds: dict[Any, Kind] = {int: "int64", float: "float64", bool: "bool"}
    return kinds.get(plain, "string")


class Facts(dict[str, Any]):
    """What an annotation says of a field, in the words of JSON Schema; hashable, so that ``| None`` may follow."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self))


Count = Annotated[int, Facts(minimum=0)]
Many = Annotated[int, Facts(minimum=1)]
NonNegative = Annotated[float, Facts(minimum=0)]
Positive = Annotated[float, Facts(exclusiveMinimum=0)]
Fraction = Annotated[float, Facts(minimum=0, maximum=1)]


def about(description: str) -> Facts:
    """Return what an annotation says of a field for people."""
    return Facts(description=description)


def with_fields(
    name: str, about: str, base: type, fields: Mapping[str, Any], own: Mapping[str, Any] | None = None
) -> Any:
    """Return a dataclass with more fields than its base, then ``own`` ones, which have no default.

    What one of the ``fields`` may lack is None, its default: an absent key of ``--json``.
    """
    made: list[Any] = [
        (key, hint, field(default=None)) if _may_lack(hint) else (key, hint) for key, hint in fields.items()
    ]
    made += (own or {}).items()
    return make_dataclass(
        name, made, bases=(base,), namespace={"__doc__": about}, frozen=True, slots=True, kw_only=True
    )


def _may_lack(hint: Any) -> bool:
    return NoneType in get_args(get_args(hint)[0] if get_origin(hint) is Annotated else hint)
