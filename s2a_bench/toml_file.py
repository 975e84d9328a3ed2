"""TOML files of users, read strictly: an error is one line that names file and key, never a number in a figure."""

from __future__ import annotations

import re
import reprlib
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from s2a_bench.errors import UsageError
from s2a_bench.text import FILE_LETTERS, like, read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

T = TypeVar("T", bound="TomlTable")

_SHOULD_BE = {
    "dict_type": "a table",
    "model_type": "a table",
    "list_type": "a list",
    "tuple_type": "a list",
    "string_type": "a text",
    "int_type": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
}
"""pydantic's type of an error -> the right type in TOML's terms."""
_WRONG = {"missing": "is missing", "too_short": "is empty"}


def _one_line(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError("should be a text of one line")
    return text


Line = Annotated[str, AfterValidator(_one_line)]
"""A text of one line that is not blank."""


class TomlTable(BaseModel):
    """Base of a table's schema: every key is known, nothing is converted, numbers are finite."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


_DEEP = re.compile(r"""(?<![\w-])(?:("[^"\n]*"|'[^'\n]*'|[\w-]+)[ \t]*\.[ \t]*){32}""")
"""A dotted key of more than 32 names: tomllib's time grows with the square of their number."""


def read(path: str | Path, option: str, most: int = FILE_LETTERS) -> str:
    """Return the text of a file that an ``option`` names; raises UsageError."""
    try:
        return read_text(path, most)
    except (OSError, ValueError) as error:  # it is not UTF-8, or its name has a NUL
        raise UsageError(f"`{option}`: cannot read {path}: {error}") from error


def loads(text: str, where: str, parse_float: Callable[[str], Any] = float) -> dict[str, Any]:
    """Read TOML text; ``where`` begins every error. Raises UsageError."""
    if _DEEP.search(text):
        raise UsageError(f"{where}: not TOML that can be read: it has a dotted key of more than 32 names")
    try:
        return tomllib.loads(text, parse_float=parse_float)
    except RecursionError:
        raise UsageError(f"{where}: not TOML that can be read: its arrays or tables are too deep") from None
    except ValueError as error:  # a TOMLDecodeError, or a whole number of thousands of digits
        raise UsageError(f"{where}: not TOML: {error}") from error


def parse(table: type[T], text: str, where: str, parse_float: Callable[[str], Any] = float) -> T:
    """Read TOML text as a table; ``where`` begins every error. Raises UsageError naming the key that is wrong."""
    return checked(table, loads(text, where, parse_float), where)


def checked(table: type[T], content: Any, where: str) -> T:
    """Return values read from TOML or JSON as a table; raises UsageError as `parse` does."""
    try:
        return table.model_validate(content)
    except ValidationError as error:
        first = min(error.errors(), key=lambda each: each["type"] != "extra_forbidden")
        raise UsageError(f"{where}: {_line(first, table, content)}") from None


def _line(error: ErrorDetails, table: type[TomlTable], content: Any) -> str:
    if not error["loc"]:
        return "it should be a table of keys"
    *inside, last = error["loc"]
    path = _path(error["loc"], content)
    if error["type"] == "extra_forbidden":
        for step in inside:
            table = _table_of(table.model_fields[step].annotation) if isinstance(step, str) else table
        names = ", ".join(table.model_fields)
        return f"{path}: there is no such key{like(str(last), table.model_fields) or f'; there are {names}'}"
    return f"{path}: {wrong(error)}"


def wrong(error: ErrorDetails) -> str:
    """Return the error of a key's value, in TOML's terms."""
    if error["type"] in _WRONG:
        return _WRONG[error["type"]]
    if error["type"] == "value_error":
        return str(error["ctx"]["error"])
    should = error["msg"].partition(" should ")[2] or error["msg"]
    kind = _SHOULD_BE.get(error["type"])
    return f"{reprlib.repr(error['input'])} should {f'be {kind}' if kind else should}"


def _path(steps: Iterable[int | str], content: Any) -> str:
    """Write a key after its tables; an element of an array appears with its ``name``, if it has one."""
    path = ""
    for step in steps:
        has_step = (isinstance(content, Mapping) and step in content) or isinstance(step, int)
        content = content[step] if has_step else None
        if isinstance(step, int):
            name = content.get("name") if isinstance(content, Mapping) else None
            path += f"[{name if isinstance(name, str) and name.isidentifier() else step}]"
        else:
            path += f".{step}" if path else step
    return path


def _table_of(annotation: Any) -> type[TomlTable]:
    if isinstance(annotation, type) and issubclass(annotation, TomlTable):
        return annotation
    return next(_table_of(each) for each in get_args(annotation) if each is not type(None))
