"""What lies in the memory for answers, each with a head of 20 bytes: tokens, actions, and what ends an answer."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, TypeAlias

import numpy as np
import orjson

from s2a_bench.trace import Remote
from s2a_bench.transport.chunks import actions_of
from s2a_bench.types import Action, Piece, Token

HEAD: Final = struct.Struct("<B3xIIq")
"""What it is, the bytes that follow, its index, and a token's id."""
_TOKEN, _ERROR, _END, _ACTION = 1, 2, 3, 4

AnswerPart: TypeAlias = "Piece | Remote | str"
"""A piece, the server's marks at the end of an answer, or the error that ended it."""


def packed(part: AnswerPart) -> bytes:
    kind, index, number = _ERROR, 0, 0
    if isinstance(part, Token):
        kind, index, number, body = _TOKEN, part.index, part.id, part.text.encode()
    elif isinstance(part, Action):
        kind, index, body = _ACTION, part.index, part.values.astype("<f4", copy=False).tobytes()
    elif isinstance(part, Remote):
        kind, body = _END, orjson.dumps(part)
    else:
        body = part.encode(errors="backslashreplace")
    return HEAD.pack(kind, len(body), index, number) + body


def unpacked(data: bytes) -> Iterator[AnswerPart]:
    """Read what was written; RequestFailed, ValueError, KeyError, TypeError or struct.error for what cannot be."""
    at = 0
    while at < len(data):
        kind, size, index, number = HEAD.unpack_from(data, at)
        at += HEAD.size + size
        if at > len(data):
            raise ValueError(f"a piece of {size} bytes lies beyond the end")
        yield _piece(kind, index, number, data[at - size : at])


def _piece(kind: int, index: int, number: int, body: bytes) -> AnswerPart:
    if kind == _TOKEN:
        return Token(index, body.decode(), number)
    if kind == _ACTION:
        (action,) = actions_of(np.frombuffer(body, "<f4"), index)
        return action
    if kind == _END:
        return Remote.of_json(orjson.loads(body))
    if kind == _ERROR:
        return body.decode(errors="replace")
    raise ValueError(f"a piece of an unknown kind, {kind}")
