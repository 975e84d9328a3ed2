"""Text from outside, as it may be shown: no letter of it moves the cursor, forges a line or turns what follows."""

from __future__ import annotations

import re

_HIDDEN = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff\ufff9-\ufffb]"
)
"""Control characters (C0, C1), marks and overrides of direction, invisible letters, halves of surrogate pairs."""


def visible(text: str) -> str:
    r"""Return a text with hidden letters escaped, as ``\u001b``; tabs and line feeds stay."""
    return _HIDDEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def one_line(text: str) -> str:
    r"""Return a text on one line: line feeds are ``\n``, tabs spaces."""
    return visible(text.replace("\n", "\\n").replace("\t", " "))
