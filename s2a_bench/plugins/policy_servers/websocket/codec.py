"""openpi's keys, and MessagePack with NumPy's arrays as it writes them, byte for byte.

An array is the map ``{b"__ndarray__": True, b"data": bytes, b"dtype": text, b"shape": [...]}``, one of NumPy's numbers
``{b"__npgeneric__": True, b"data": its value, b"dtype": text}``. The keys of an array may be texts, as vla-eval has
them. Arrays are of numbers and texts: no objects (dtype kind O), no records (V), no complex numbers (c), which openpi
refuses too.

Our client announces itself in a header of its handshake, `MARKS_HEADER`. Then its observations have what
`observed` adds, and each answer is followed by one more frame with the server's marks.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import msgpack
import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import array_in, unpacked

MARKS_HEADER: Final = "S2A-Marks"
OURS: Final = "s2a-bench"
"""The ``server`` of our server's greeting."""
SCHEME: Final = "Api-Key"
"""The scheme of the Authorization header that openpi's client sends."""
HEALTH: Final = "/healthz"
ACTIONS, TYPE, TIMING, INDICES = "actions", "type", "server_timing", "action_indices"
PARTIAL, FINAL = "partial", "final"
ERROR = "error"
ERROR_KEYS: Final = ("message", ERROR, "payload")
"""Keys under which servers describe an error in a binary message, some of them nested."""
QUIET: Final = logging.getLogger("s2a_bench.websocket")
"""websockets' logger, silenced: our errors report the same."""
QUIET.addHandler(logging.NullHandler())
QUIET.propagate = False

ARRAY, GENERIC = b"__ndarray__", b"__npgeneric__"
UNSAFE: Final = "VOc"
"""Kinds of dtypes that do not travel."""
LONGEST: Final = 32
"""Letters of a dtype: NumPy takes minutes for long ones, of many fields."""


def packb(value: Any, *, text_keys: bool = False) -> bytes:
    """Write a message, the keys of its arrays as bytes or texts; raises RequestFailed for what does not travel."""
    try:
        packed: bytes = msgpack.packb(value, default=_text_keyed if text_keys else _packable)
    except (TypeError, ValueError, OverflowError) as error:
        raise RequestFailed(f"a message that MessagePack cannot carry: {error}") from error
    return packed


def _packable(value: Any) -> Any:
    if not isinstance(value, (np.ndarray, np.generic)):
        raise TypeError(f"{type(value).__name__} is not one of its types")
    if value.dtype.kind in UNSAFE:
        raise ValueError(f"arrays of type {value.dtype} do not travel")
    if isinstance(value, np.generic):
        return {GENERIC: True, b"data": value.item(), b"dtype": value.dtype.str}
    data = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data  # without the copy of tobytes
    return {ARRAY: True, b"data": data, b"dtype": value.dtype.str, b"shape": value.shape}


def _text_keyed(value: Any) -> Any:
    return {key if isinstance(key, str) else key.decode(): each for key, each in _packable(value).items()}


def unpackb(data: bytes | bytearray | memoryview) -> Any:
    """Read a message, whose arrays are read-only views of their bytes; raises RequestFailed for any other bytes."""
    return unpacked(data, _of_map)


def _of_map(value: dict[Any, Any]) -> Any:
    if ARRAY.decode() in value:
        value = {key.encode() if isinstance(key, str) else key: each for key, each in value.items()}
    if ARRAY in value:
        return array_in(value.get(b"data"), value.get(b"shape"), _dtype(value))
    if GENERIC in value:
        with np.errstate(over="ignore"):  # it is infinite, which later checks refuse
            return _dtype(value).type(value.get(b"data"))
    return value


def _dtype(fields: dict[Any, Any]) -> np.dtype[Any]:
    text = fields.get(b"dtype")
    dtype = np.dtype(text) if isinstance(text, str) and len(text) <= LONGEST else None
    if dtype is None or dtype.kind in UNSAFE or not dtype.itemsize:
        raise ValueError(f"an array of type {str(text)[:40]!r}, which does not travel")
    return dtype
