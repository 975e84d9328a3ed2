"""Messages as GR00T packs them: MessagePack in which an array of numbers is a map with a NumPy file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.transport.messagepack import unpacked
from s2a_bench.transport.zmq.npy import Room, array_of, file_of

ARRAY, FILE = "__ndarray_class__", "as_npy"
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
    return unpacked(data, lambda value: array_of(value.get(FILE)) if ARRAY in value else value)
