"""Answers of *binary* with actions: each action as bytes, the end or an error as a block of JSON.

A block is the length of what follows (uint32), then b"A", the tick (uint32) and the float32 of one action, or b"J" and
JSON; all little endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import orjson

from s2a_bench.transport.chunks import actions_of
from s2a_bench.transport.http.dialects.framing import LIMIT
from s2a_bench.types import Action

MEDIA_TYPE: Final = "application/x-s2a-actions"
LENGTH: Final = struct.Struct("<I")
ACTION, JSON = b"A", b"J"


def of_action(action: Action) -> bytes:
    block = ACTION + LENGTH.pack(action.index) + action.values.astype("<f4").tobytes()
    return LENGTH.pack(len(block)) + block


def json_block(message: Any) -> bytes:
    block = JSON + orjson.dumps(message)
    return LENGTH.pack(len(block)) + block


def read_block(block: bytes) -> Any:
    """Return a block's content as a message of the native dialect; raises ValueError or RequestFailed."""
    if block[:1] == JSON:
        return orjson.loads(block[1:])
    if block[:1] != ACTION or len(block) <= 1 + LENGTH.size or (len(block) - 1 - LENGTH.size) % 4:
        raise ValueError("a block that is neither an action nor JSON")
    (index,) = LENGTH.unpack_from(block, 1)
    values = np.frombuffer(block, "<f4", offset=1 + LENGTH.size)
    return {"choices": [{"actions": actions_of(values, index)}]}


class Blocks:
    """A framing that cuts a body into blocks, see `dialects.framing`."""

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        self._held += data
        while len(self._held) >= LENGTH.size:
            (size,) = LENGTH.unpack_from(self._held)
            if size > LIMIT:
                raise ValueError(f"a block of {size} bytes")
            if len(self._held) < LENGTH.size + size:
                return
            block = bytes(self._held[LENGTH.size : LENGTH.size + size])
            del self._held[: LENGTH.size + size]
            yield block

    def end(self) -> Iterator[bytes]:
        """Yield nothing; raises ValueError for a truncated block."""
        if self._held:
            raise ValueError("a block that is cut off")
        yield from ()
