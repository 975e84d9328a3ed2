"""What lies in the memory for answers: pieces, each with a head of 16 bytes, and what ends an answer."""

from __future__ import annotations

import struct
from typing import Final, TypeAlias

import orjson

from s2a_bench.trace import Remote
from s2a_bench.types import Token

_HEAD: Final = struct.Struct("<B3xIq")
"""What it is, its index, and a token's id."""
_TOKEN, _ERROR, _END = 1, 2, 3

Said: TypeAlias = "Token | Remote | str"
"""A piece; or the end of an answer, with the server's marks; or why there is no more."""


def packed(said: Said) -> bytes:
    """Return what is written."""
    if isinstance(said, Token):
        return _HEAD.pack(_TOKEN, said.index, said.id) + said.text.encode()
    if isinstance(said, Remote):
        return _HEAD.pack(_END, 0, 0) + orjson.dumps(said)
    return _HEAD.pack(_ERROR, 0, 0) + said.encode(errors="backslashreplace")


def unpacked(data: bytes) -> Said:
    """Read what was written; raises ValueError, KeyError, TypeError or struct.error for what cannot be."""
    kind, index, number = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    if kind == _TOKEN:
        return Token(index, body.decode(), number)
    if kind == _END:
        return Remote.of_json(orjson.loads(body))
    if kind == _ERROR:
        return body.decode(errors="replace")
    raise ValueError(f"a piece of an unknown kind, {kind}")
