"""MessagePack from outside: plain values, whose maps a protocol may convert, to arrays for example.

Values are numbers, texts, bytes, lists and dictionaries; no extension type is read, not even MessagePack's time stamps.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import RequestFailed

LIST, MAP = 4096, 1024
"""The most elements of a list, and keys of a map; an array of numbers is one value."""


def unpacked(data: Any, of_map: Callable[[dict[Any, Any]], Any]) -> Any:
    """Read the message in a buffer, each map converted by ``of_map``; raises RequestFailed for invalid bytes.

    ``of_map`` raises ValueError or RequestFailed for a map that it refuses.
    """
    try:
        return msgpack.unpackb(
            data,
            object_hook=of_map,
            ext_hook=_no_extension,
            max_array_len=LIST,
            max_map_len=MAP,
            max_ext_len=0,  # the hook never gets time stamps; empty extensions pass this
        )
    except (
        RequestFailed,
        ValueError,
        TypeError,
        OverflowError,
        RecursionError,
        SyntaxError,
    ) as error:  # NumPy's of dtypes
        why = str(error) or type(error).__name__
        raise RequestFailed(f"{len(data)} bytes that are not a message: {why}") from error


def _no_extension(code: int, _: bytes) -> Any:
    raise ValueError(f"an extension of type {code}, which is not allowed")


def array_in(data: Any, shape: Any, dtype: np.dtype[Any], start: int = 0) -> NDArray[Any]:
    """Return the read-only array whose elements begin at ``start``; raises RequestFailed if the bytes do not fit."""
    if not isinstance(data, bytes):
        raise RequestFailed(f"an array whose data is {type(data).__name__}, not bytes")
    axes: list[Any] = list(shape) if isinstance(shape, (list, tuple)) else [None]
    if not all(type(axis) is int and axis >= 0 for axis in axes):
        raise RequestFailed(f"an array whose shape is invalid: {str(shape)[:80]}")
    size = len(data) - start
    if prod(axes) * dtype.itemsize != size:
        raise RequestFailed(f"an array of shape {str(tuple(axes))[:80]} and type {dtype} in {size} bytes")
    flat = np.frombuffer(data, dtype, offset=start) if size else np.empty(0, dtype)
    return flat.reshape(axes)
