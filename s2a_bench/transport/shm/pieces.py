"""What lies in the memory for answers, each with a head of 16 bytes: tokens, actions, and what ends an answer."""

from __future__ import annotations

import struct
from typing import Final, TypeAlias

import numpy as np
import orjson

from s2a_bench.trace import Remote
from s2a_bench.transport.chunks import actions_of
from s2a_bench.types import Action, Piece, Token

_HEAD: Final = struct.Struct("<B3xIq")
"""What it is, its index, and a token's id."""
_TOKEN, _ERROR, _END, _ACTION = 1, 2, 3, 4

Said: TypeAlias = "Piece | Remote | str"
"""A piece; or the end of an answer, with the server's marks; or why there is no more."""


def packed(said: Said) -> bytes:
    """Return what is written."""
    if isinstance(said, Token):
        return _HEAD.pack(_TOKEN, said.index, said.id) + said.text.encode()
    if isinstance(said, Action):
        return _HEAD.pack(_ACTION, said.index, 0) + said.values.astype("<f4", copy=False).tobytes()
    if isinstance(said, Remote):
        return _HEAD.pack(_END, 0, 0) + orjson.dumps(said)
    return _HEAD.pack(_ERROR, 0, 0) + said.encode(errors="backslashreplace")


def unpacked(data: bytes) -> Said:
    """Read what was written; RequestFailed, ValueError, KeyError, TypeError or struct.error for what cannot be."""
    kind, index, number = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
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
