"""Text from outside: read within bounds; shown without letters that move the cursor, forge a line or reverse others."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

_HIDDEN = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff\ufff9-\ufffb]"
)
"""Control characters (C0, C1), marks and overrides of direction, invisible letters, halves of surrogate pairs."""

FILE_LETTERS: Final = 8 << 20
"""Limit on a user's text files."""


def read_text(path: str | Path, most: int = FILE_LETTERS) -> str:
    """Read a user's UTF-8 file; raises UnicodeDecodeError, and OSError, also for more than ``most`` letters."""
    with Path(path).open(encoding="utf-8") as file:
        text = file.read(most + 1)
    if len(text) > most:
        raise OSError(f"it is longer than {most} letters")
    return text


def visible(text: str) -> str:
    r"""Return a text with hidden letters escaped, as ``\u001b``; tabs and line feeds stay."""
    return _HIDDEN.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: str) -> str:
    r"""Return a text on one line: line feeds are ``\n``, tabs spaces."""
    return visible(text.replace("\n", "\\n").replace("\t", " "))


def dotted(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings under dotted names."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def like(name: str, names: Iterable[str]) -> str:
    """Return the question at the end of an error about an unknown name, or nothing if no known name is close."""
    close = get_close_matches(name.lower(), [*names], 1)
    return f"; did you mean {close[0]}?" if close else ""


def none_of(name: str, names: Collection[str], more: str = "") -> str:
    """Return the error about an unknown name: the known ones, ``more``, and the closest."""
    return f"'{name}' is not one of {', '.join(filter(None, names))}{more}{like(name, names)}"
