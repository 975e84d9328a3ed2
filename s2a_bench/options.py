"""Options, declared once: a documented, typed, bounded field of a configuration.

Its flag and ``--help``, its validation, the sweep axis, the manifest's entry and the table in docs/ follow from the
field. Every configuration is valid: its constructor raises UsageError, which names the field.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, TypeVar, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from s2a_bench.errors import UsageError
from s2a_bench.text import like, none_of, read_text

SomeOptions = TypeVar("SomeOptions", bound="Options")


class Options(BaseModel):
    """Base of configurations; an option is a field made with `option`, a group of options a field of such a class."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    PANEL: ClassVar[str] = ""
    """The heading in ``--help`` of the options without a panel that this class declares."""
    virtual: ClassVar[bool] = False
    """Whether a run computes in virtual time, so that several may share a machine; measuring runs may not."""

    def __init__(self, **values: Any) -> None:
        """Raise UsageError, naming the field, for an invalid value."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise UsageError(_line(error.errors()[0], type(self))) from None

    def model_post_init(self, _context: Any) -> None:
        self.check()

    def check(self) -> None:
        """Raise UsageError, naming the fields, for values that contradict each other."""

    def but(self: SomeOptions, **changes: Any) -> SomeOptions:  # noqa: PYI019 - typing has Self since Python 3.11
        """Return a copy with some fields changed, checked like a new one."""
        return type(self)(**self.given_values() | changes)

    def given_values(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.model_fields_set}

    def risks(self) -> Iterator[tuple[str, str, str]]:
        """Yield name, `risk` and value of the given fields that an untrusted file should not set."""
        for name in self.model_fields_set:
            value = getattr(self, name)
            if isinstance(value, Options):
                yield from value.risks()
            elif value and (risk := str(extra_of(type(self).model_fields[name]).get("risk", ""))):
                yield name, risk, str(value)

    def to_manifest(self) -> dict[str, Any]:
        return self.model_dump()


def option(
    default: Any,
    about: str,
    *,
    flag: str = "",
    argument: bool = False,
    hidden: bool = False,
    side: str = "",
    risk: Literal["", "program", "url", "key"] = "",
    panel: str = "",
    first: bool = False,
    names: Callable[[], Iterable[str]] | None = None,
    **bounds: Any,
) -> Any:
    """Declare a field: ``about`` is its help, ``flag`` its name on the command line unless that is the field's.

    On the command line an ``argument`` is given by its position instead of a flag, and the help omits a ``hidden``
    flag. ``side`` is for the options of a transport, see `transport`. ``risk``: the value names a program to run, a
    server that receives requests, or a key for it. ``panel`` is the heading in ``--help``, by default that of the
    class; ``--help`` of a command with many flags shows those that are ``first``. ``names`` returns the completions of
    a shell, for a value that `one_of` does not check. A field whose ``default`` is `...` is required. ``bounds`` are
    pydantic's: ge, gt, le, lt, min_length, pattern.
    """
    extra: dict[str, Any] = {"flag": flag, "argument": argument, "hidden": hidden, "side": side, "risk": risk}
    extra |= {"panel": panel, "first": first, "names": names}
    return Field(default, description=about, json_schema_extra=extra, **bounds)


def group(
    options: type[Options], *, only: Iterable[str] = (), about: str = "", first: Iterable[str] | None = None
) -> Any:
    """Declare a group of options, of which ``only`` some are flags; ``about`` precedes the help of each.

    ``first`` names the flags that come first in ``--help``; by default ``options`` declares them.
    """
    extra: dict[str, Any] = {"only": [*only], "about": about, "first": None if first is None else [*first]}
    return Field(default_factory=options, json_schema_extra=extra)


def group_of(field: FieldInfo) -> type[Options] | None:
    """Return the class of a group of options; None for a single option."""
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Options) else None


def extra_of(field: FieldInfo) -> Mapping[str, Any]:
    """Return the arguments of `option` or `group` that pydantic does not have."""
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def help_place(options: type[Options], name: str) -> tuple[str, bool]:
    """Return the heading of a field's option in ``--help``, and whether it is one of the first there.

    A class that declares a field again, with another default, inherits them.
    """
    bases = [each for each in options.__mro__ if issubclass(each, Options) and name in each.model_fields]
    extras = [extra_of(each.model_fields[name]) for each in bases]
    panel = next((str(each["panel"]) for each in extras if each.get("panel")), bases[-1].PANEL)
    return panel, any(each.get("first") for each in extras)


Place: TypeAlias = tuple[str, ...]
"""The field of an option, after the fields of its groups."""


def beside(path: Place, other: Place) -> bool:
    """Whether two options are in sibling groups, where one name sets both: the port of any server."""
    return len(path) == len(other) and path[:-2] == other[:-2]


def places(options: type[Options]) -> dict[str, list[Place]]:
    """Return every name of an option, its field's and its flag's, with the paths to its fields.

    The options of a group that are flags keep their names; sibling groups share the names that both have.
    """
    paths_of: dict[str, list[Place]] = {}
    for name, field in options.model_fields.items():
        if inner := group_of(field):
            only = extra_of(field).get("only")
            for each, paths in places(inner).items():
                new = [(name, *path) for path in paths if not only or path[0] in only]
                if not new:
                    continue
                paths_so_far = paths_of.setdefault(each, new)
                if paths_so_far is not new and beside(paths_so_far[0], new[0]):
                    paths_so_far += new
    for name, field in options.model_fields.items():
        if group_of(field) is None:
            paths_of |= {name: [(name,)], str(extra_of(field).get("flag") or name).replace("-", "_"): [(name,)]}
    return paths_of


def placed(options: type[Options], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return options, each given by one of its names, as arguments of the class; unknown names stay."""
    paths = places(options)

    def at(name: str, value: Any) -> list[Place]:
        whole = name in options.model_fields and isinstance(value, (Options, dict))
        return [(name,)] if whole else paths.get(name, [(name,)])

    return nested((path, value) for name, value in values.items() for path in at(name, value))


def nested(values: Iterable[tuple[tuple[str, ...], Any]]) -> dict[str, Any]:
    """Return values, each with the path to its field, as arguments of a class of options: groups as dictionaries."""
    tree: dict[str, Any] = {}
    for (*groups, last), value in values:
        inner = tree
        for each in groups:
            inner = inner.setdefault(each, {})
        inner[last] = value
    return tree


def _line(error: ErrorDetails, options: type[Options]) -> str:
    field = str(error["loc"][0]) if error["loc"] else ""
    if error["type"] == "extra_forbidden":
        names = options.model_fields
        return f"`{field}` is not one of the options {', '.join(names)}{like(field, names)}"
    if error["type"] == "missing":
        return f"`{field}` is needed"
    if error["type"] == "too_short":
        return f"`{field}`: name at least one"
    if error["type"] == "value_error":
        return f"`{field}`: {error['ctx']['error']}"
    message = re.sub("^(Input|Value|String) ", "", error["msg"])
    return f"`{field}`: {error['input']!r} {message}"


def need_program(field: str, path: Path) -> None:
    """Raise UsageError if the path of a field is not an executable program."""
    if not (path.is_file() and os.access(path, os.X_OK)):
        raise UsageError(f"`{field}`: {path} is not an executable program")


def listed(value: Any) -> tuple[Any, ...]:
    """Split text at commas, make a tuple of any other value, and keep each element once."""
    if isinstance(value, str):
        value = [text.strip() for text in value.split(",") if text.strip()]
    elif not isinstance(value, Iterable):
        value = [value]
    return tuple(dict.fromkeys(value))


def one_of(names: Callable[[], Iterable[str]]) -> AfterValidator:
    """Return a validator: the value, or each of several, is one of ``names()``, called on validation."""
    return AfterValidator(partial(_one_of, names))


def _one_of(names: Callable[[], Iterable[str]], value: Any) -> Any:
    for each in value if isinstance(value, tuple) else (value,):
        if each not in (allowed := tuple(names())):
            raise ValueError(none_of(each, allowed))
    return value


def completions(field: FieldInfo) -> Callable[[], Iterable[str]] | None:
    """Return the function that lists the names for an option's value, or None."""
    checks: Iterable[Any] = (getattr(each, "func", None) for each in field.metadata)
    kinds = (field.annotation, *get_args(field.annotation))
    literal = next((get_args(each) for each in kinds if get_origin(each) is Literal), ())
    checked = next((each.args[0] for each in checks if getattr(each, "func", None) is _one_of), None)
    return checked or extra_of(field).get("names") or ((lambda: literal) if literal else None)


def _size(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    width, cross, height = value.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"'{value}' should look like 640x480")
    return int(width), int(height)


def _square(value: Any) -> Any:
    return (int(value), int(value)) if isinstance(value, str) and value.isdecimal() else _size(value)


def _text(value: Any) -> Any:
    return _sound(_content(value[1:]) if isinstance(value, str) and value.startswith("@") else value)


def _grammar(value: Any) -> Any:
    return _sound(value if isinstance(value, str) and (not value or "::=" in value) else _content(value))


def _content(path: str | Path) -> str:
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error


def _sound(text: Any) -> Any:
    if isinstance(text, str) and ("\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text)):
        raise ValueError("the text is not valid UTF-8, or has a NUL")
    return text


SEVERAL = BeforeValidator(listed)
"""Splits text at commas to a tuple, each element once."""

Names = Annotated[tuple[str, ...], SEVERAL]
Numbers = Annotated[tuple[float, ...], SEVERAL]

Size = Annotated[tuple[int, int], BeforeValidator(_size, json_schema_input_type=str | tuple[int, int])]
"""Width and height; as text 640x480."""

Square = Annotated[tuple[int, int], BeforeValidator(_square, json_schema_input_type=str | tuple[int, int])]
"""Width and height; as text 224x224, or 224 for both."""

TextOrFile = Annotated[str, BeforeValidator(_text)]
"""A text, or the content of the file that @FILE names."""

Grammar = Annotated[str, BeforeValidator(_grammar)]
"""A grammar in GBNF, or the content of its file."""
