"""MessagePack from outside: a bounded number of plain values, and what a protocol makes of its maps.

Bytes become nothing but numbers, texts, bytes, lists and dictionaries; no extension type is read, msgpack's own time
stamps included.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack

from s2a_bench.errors import RequestFailed

LIST, MAP, VALUES = 4096, 1024, 1 << 16
"""The most elements of a list, keys of a map, and elements and keys of a whole message; arrays are one each."""


def unpacked(data: Any, of_map: Callable[[dict[Any, Any]], Any]) -> Any:
    """Read the message in a buffer, each map as ``of_map`` has it; raises RequestFailed for any other bytes.

    What ``of_map`` refuses it says with a ValueError or a RequestFailed.
    """
    reader = _Reader(of_map)
    try:
        return msgpack.unpackb(
            data,
            object_hook=reader.map,
            list_hook=reader.list,
            ext_hook=_no_extension,
            max_array_len=LIST,
            max_map_len=MAP,
            max_ext_len=0,  # time stamps never come to the hook, and empty ones pass this
        )
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # msgpack's own are ValueErrors
        raise RequestFailed(f"{len(data)} bytes that are no message: {str(error) or type(error).__name__}") from error


class _Reader:
    """The hooks of one message, which count what it has."""

    def __init__(self, of_map: Callable[[dict[Any, Any]], Any]) -> None:
        self._of_map = of_map
        self._left = VALUES

    def list(self, value: list[Any]) -> list[Any]:
        self._count(len(value))
        return value

    def map(self, value: dict[Any, Any]) -> Any:
        self._count(len(value))
        return self._of_map(value)

    def _count(self, number: int) -> None:
        self._left -= number + 1
        if self._left < 0:
            raise ValueError(f"it has more than {VALUES} values")


def _no_extension(code: int, _: bytes) -> Any:
    raise ValueError(f"an extension of type {code}, which nobody knows")
