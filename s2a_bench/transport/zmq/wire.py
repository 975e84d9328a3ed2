"""Messages as GR00T packs them: MessagePack in which an array is a map with a NumPy file; bounded on reading.

No other hook is called, so bytes become nothing but numbers, texts, bytes, lists, dictionaries and arrays of numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.transport.zmq.npy import Room, array_of, file_of

ARRAY, FILE = "__ndarray_class__", "as_npy"
LIST, MAP, VALUES = 4096, 1024, 1 << 16
"""The most elements of a list, keys of a map, and elements and keys of a whole message; arrays are one each."""
SMALL: Final = 1 << 16
"""Bytes that a message without large pictures takes, or fewer."""
NO_ROOMS: Final[Mapping[int, Room]] = {}


def pack(message: Any, rooms: Mapping[int, Room] = NO_ROOMS) -> memoryview:
    """Return a message; raises RequestFailed for values that cannot travel.

    An array whose pixels are in one of ``rooms``, by their address, is sent from there.
    """

    def plain(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} is none of its types")
        room = rooms.get(value.__array_interface__["data"][0])
        return {ARRAY: True, FILE: (room.file(value) if room else None) or file_of(value)}

    size = SMALL + sum(room.pixels.size for room in rooms.values())
    try:
        packer = msgpack.Packer(default=plain, autoreset=False, buf_size=size)
        packer.pack(message)
    except (TypeError, ValueError, OverflowError) as error:
        raise RequestFailed(f"a message that MessagePack cannot carry: {error}") from error
    return memoryview(packer.getbuffer())  # without the copy of packb


def unpack(data: Any) -> Any:
    """Return the message in a buffer, its arrays read-only; raises RequestFailed for any other bytes."""
    reader = _Reader()
    try:
        return msgpack.unpackb(
            data,
            object_hook=reader.map,
            list_hook=reader.list,
            max_array_len=LIST,
            max_map_len=MAP,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # msgpack's own are ValueErrors
        raise RequestFailed(f"{len(data)} bytes that are no message: {error or type(error).__name__}") from error


class _Reader:
    """The hooks of one message, which count what it has."""

    def __init__(self) -> None:
        self._left = VALUES

    def list(self, value: list[Any]) -> list[Any]:
        self._count(len(value))
        return value

    def map(self, value: dict[Any, Any]) -> Any:
        self._count(len(value))
        return array_of(value.get(FILE)) if ARRAY in value else value

    def _count(self, number: int) -> None:
        self._left -= number + 1
        if self._left < 0:
            raise ValueError(f"it has more than {VALUES} values")
