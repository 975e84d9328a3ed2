"""Policies with parameters as users write them: ``name?parameter=value&other=value``.

Parameters are the fields of the policy's dataclass whose default is a number or a text; their annotations, pydantic's
``Field`` included, define the valid values. A class with ``passes_on`` keeps other parameters
as pairs of texts in the field of that name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, fields, is_dataclass
from typing import Any, TypeVar, get_type_hints

from s2a_bench.errors import UsageError
from s2a_bench.text import like

T = TypeVar("T")


def build(made_by: Callable[..., T], written: str, field: str = "policy") -> T:
    """Build ``name?parameter=value&...``; raises UsageError naming ``field``, the parameter, and the known ones."""
    name, _, query = written.partition("?")
    hints = get_type_hints(made_by, include_extras=True) if query and is_dataclass(made_by) else {}
    types = {each.name: hints[each.name] for each in _parameters(made_by)} if query else {}
    rest = getattr(made_by, "passes_on", "")
    names = f"its parameters are {', '.join(types)}" if types else "it has no parameters"
    values: dict[str, Any] = {}
    others = list[tuple[str, str]]()
    for pair in query.split("&") if query else ():
        parameter, _, text = pair.partition("=")
        if parameter not in types and rest:
            others.append((parameter, text))
            continue
        if parameter not in types or parameter in values:
            wrong = "is given twice" if parameter in values else "is not a parameter"
            meant = "" if parameter in values else like(parameter, types)
            raise UsageError(f"`{field}`: {name}: '{parameter}' {wrong}; {names}{meant}")
        values[parameter] = _value(types[parameter], text, f"`{field}`: {name}: {parameter} = '{text}'", names)
    if others:
        values[rest] = tuple(others)
    try:
        return made_by(**values)
    except UsageError as error:
        hint = f"; {names}" if query else ""
        raise UsageError(f"`{field}`: {name}: {error}{hint}") from error


def canonical(name: str, policy: object) -> str:
    """Return the text of a policy or mode: parameters sorted by name, those at their default left out."""
    texts = {}
    for field in _parameters(type(policy)):
        value = getattr(policy, field.name)
        if value != field.default:
            texts[field.name] = f"{value:.12g}" if isinstance(value, float) else str(value)
    pairs = "&".join(f"{parameter}={text}" for parameter, text in sorted(texts.items()))
    return f"{name}?{pairs}" if pairs else name


def _value(type_: Any, text: str, what: str, names: str) -> Any:
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(type_).validate_strings(text)
    except ValidationError as error:
        wrong = error.errors()[0]["msg"]
        raise UsageError(f"{what}: {wrong[0].lower()}{wrong[1:]}; {names}") from error


def _parameters(made_by: Any) -> list[Field[Any]]:
    declared = fields(made_by) if is_dataclass(made_by) else ()
    return [field for field in declared if isinstance(field.default, bool | int | float | str | None)]
