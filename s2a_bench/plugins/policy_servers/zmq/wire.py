"""Messages as GR00T packs them: MessagePack in which an array of numbers is a map.

Up to N1.6 the map holds a NumPy file, ``{"__ndarray_class__": True, "as_npy"}``. From N1.7 on it is that of
msgpack-numpy 0.4.8, ``{b"nd": True, b"type", b"kind", b"shape", b"data"}``, or ``{b"nd": False, b"type", b"data"}`` for
NumPy's scalars, whose kinds O (a pickle) and V (records) are refused. Both are read wherever they stand.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import array_in, unpacked
from s2a_bench.plugins.policy_servers.zmq.layouts import CONFIG_MARKS, N1_5, N1_6, N1_7, OURS
from s2a_bench.plugins.policy_servers.zmq.npy import PictureFile, array_of, file_of

ARRAY, FILE = "__ndarray_class__", "as_npy"
ND, TYPE, KIND, SHAPE, BYTES = "nd", "type", "kind", "shape", "data"
SMALL: Final = 1 << 16
"""Bytes that a message without large pictures takes, or fewer."""
NO_FILES: Final[Mapping[int, PictureFile]] = {}

_NUMBERS = re.compile(r"[<>|=](b1|[iu][1248]|f[248])")
"""What msgpack-numpy calls types of numbers."""


def pack(message: Any, files: Mapping[int, PictureFile] = NO_FILES, *, maps: bool = False) -> memoryview:
    """Return a message, its arrays as files or as ``maps`` of msgpack-numpy; raises RequestFailed for other values.

    An array whose pixels are in one of ``files``, by their address, is sent from there.
    """

    def plain(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} is none of its types")
        if maps:  # its elements are packed from where they are
            solid = np.ascontiguousarray(value)
            data = solid.reshape(-1).view(np.uint8).data
            fields = {ND: True, TYPE: solid.dtype.str, KIND: b"", SHAPE: value.shape, BYTES: data}
            return {key.encode(): each for key, each in fields.items()}
        file = files.get(value.__array_interface__["data"][0])
        return {ARRAY: True, FILE: (file.file(value) if file else None) or file_of(value)}

    size = SMALL + sum(file.pixels.size for file in files.values())
    try:
        packer = msgpack.Packer(default=plain, autoreset=False, buf_size=size)
        packer.pack(message)
    except (TypeError, ValueError, OverflowError) as error:
        raise RequestFailed(f"a message that MessagePack cannot carry: {error}") from error
    return memoryview(packer.getbuffer())  # without the copy of packb


def read(data: Any) -> tuple[Any, set[str]]:
    """Return the message in a buffer, its arrays read-only, and the marks of its arrays and configurations.

    Marks are N1.5 to N1.7, and `OURS`. Raises RequestFailed for any other bytes.
    """
    marks: set[str] = set()

    def plain(value: dict[Any, Any]) -> Any:
        if ARRAY in value:
            marks.add(N1_6)
            return array_of(value.get(FILE))
        if b"nd" in value or ND in value:
            fields = {key.decode() if isinstance(key, bytes) else key: each for key, each in value.items()}
            if fields.keys() >= {TYPE, BYTES}:
                marks.add(N1_7)
                return _array_in(fields)
        for layout, mark in (*CONFIG_MARKS.items(), (OURS, OURS)):
            if mark in value:
                marks.add(N1_5 if layout == N1_6 and isinstance(value.get("as_json"), str) else layout)
        return value

    return unpacked(data, plain), marks


def _array_in(fields: Mapping[str, Any]) -> Any:
    """Return the read-only array, or scalar, in a map of msgpack-numpy; raises RequestFailed for what is none."""
    kind, descr, data = fields.get(KIND) or b"", fields[TYPE], fields[BYTES]
    shape = fields.get(SHAPE) if fields[ND] else []
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else kind
    if kind in ("O", "V") or not isinstance(descr, str) or not _NUMBERS.fullmatch(descr):
        raise RequestFailed(
            f"an array of kind {str(kind)[:8]!r} and type {str(descr)[:80]!r}: numbers are taken, nothing is unpickled"
        )
    array = array_in(data, shape, np.dtype(descr))
    return array if fields[ND] else array[()]
