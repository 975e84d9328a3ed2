"""Messages as GR00T packs them: MessagePack in which an array of numbers is a map.

Up to N1.6 the map holds a NumPy file, ``{"__ndarray_class__": True, "as_npy"}``, of format 1.0 or later. From N1.7 on
it is that of msgpack-numpy 0.4.8, ``{b"nd": True, b"type", b"kind", b"shape", b"data"}``, or ``{b"nd": False, b"type",
b"data"}`` for NumPy's scalars, whose kinds O (a pickle) and V (records) are refused. Both are read wherever they stand,
without a copy; nothing is ever unpickled.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

import msgpack
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import array_in, unpacked
from s2a_bench.plugins.policy_servers.zmq.layouts import CONFIG_MARKS, N1_5, N1_6, N1_7, OURS
from s2a_bench.types import Pixels

ARRAY, FILE = "__ndarray_class__", "as_npy"
SMALL: Final = 1 << 16
"""Bytes that a message without large pictures takes, or fewer."""
NO_FILES: Final[Mapping[int, PictureFile]] = {}
BEFORE: Final = 128
"""Bytes of the header of a picture, and of most."""

_NUMBERS = re.compile(r"[<>|=](b1|[iu][1248]|f[248])")
"""The names of number types in msgpack-numpy."""


class PictureFile:
    """A NumPy file, whose head stands before its pixels: a conversion writes them where they are sent from."""

    def __init__(self, height: int, width: int) -> None:
        self._whole = np.empty(BEFORE + height * width * 3, np.uint8)
        self.pixels: Pixels = self._whole[BEFORE:].reshape(height, width, 3)
        self.address: int = self.pixels.__array_interface__["data"][0]

    def file(self, array: NDArray[Any]) -> memoryview | None:
        """Return the file of these very pixels in any shape; None where the array is something else."""
        if array.dtype != np.uint8 or array.size != self.pixels.size or not array.flags.c_contiguous:
            return None
        head = _head(array.shape, "|u1")
        if len(head) > BEFORE:
            return None
        self._whole[BEFORE - len(head) : BEFORE] = np.frombuffer(head, np.uint8)
        return self._whole[BEFORE - len(head) :].data


def pack(message: Any, files: Mapping[int, PictureFile] = NO_FILES, *, maps: bool = False) -> memoryview:
    """Return a message, its arrays as files or as ``maps`` of msgpack-numpy; raises RequestFailed for other values.

    An array whose pixels are in one of ``files``, by their address, is sent from there.
    """

    def plain(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} is not one of its types")
        if maps:  # its elements are packed from where they are
            solid = np.ascontiguousarray(value)
            data = solid.reshape(-1).view(np.uint8).data
            return {b"nd": True, b"type": solid.dtype.str, b"kind": b"", b"shape": value.shape, b"data": data}
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
        if b"nd" in value or "nd" in value:
            fields = {key.decode() if isinstance(key, bytes) else key: each for key, each in value.items()}
            if fields.keys() >= {"type", "data"}:
                marks.add(N1_7)
                return _array_in(fields)
        for layout, mark in (*CONFIG_MARKS.items(), (OURS, OURS)):
            if mark in value:
                marks.add(N1_5 if layout == N1_6 and isinstance(value.get("as_json"), str) else layout)
        return value

    return unpacked(data, plain), marks


def _array_in(fields: Mapping[str, Any]) -> Any:
    """Return the read-only array, or scalar, in a map of msgpack-numpy; raises RequestFailed for anything else."""
    kind, descr, data = fields.get("kind") or b"", fields["type"], fields["data"]
    shape = fields.get("shape") if fields["nd"] else []
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else kind
    if kind in ("O", "V") or not isinstance(descr, str) or not _NUMBERS.fullmatch(descr):
        raise RequestFailed(
            f"an array of kind {str(kind)[:8]!r} and type {str(descr)[:80]!r}: numbers are taken, nothing is unpickled"
        )
    array = array_in(data, shape, np.dtype(descr))
    return array if fields["nd"] else array[()]


def file_of(array: NDArray[Any]) -> bytes:
    solid = np.ascontiguousarray(array)
    return b"".join((_head(array.shape, solid.dtype.str), solid.reshape(-1).view(np.uint8).data))


def array_of(data: Any) -> NDArray[Any]:
    """Return the read-only array in a file, not copied; raises RequestFailed for other bytes, types and sizes."""
    if not isinstance(data, bytes):
        raise RequestFailed(f"an array whose as_npy is {type(data).__name__}, not bytes")
    text = 10 if data[6:7] == b"\x01" else 12  # where the header's text begins, behind its length
    head = data[: text + int.from_bytes(data[8:text], "little")]
    shape, fortran, dtype = _read_head(head)
    array = array_in(data, shape[::-1] if fortran else shape, dtype, len(head))
    return array.T if fortran else array


@lru_cache(64)
def _read_head(head: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return the shape of the array behind a file's head, whether it is in Fortran's order, and its type."""
    file, wrong = io.BytesIO(head), RequestFailed(f"a NumPy file of {head[10:90]!r}; numbers are taken, nothing else")
    try:
        read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read(file)
    except Exception as error:  # NumPy's reader raises whatever Python's tokenizer does
        raise wrong from error
    if dtype.kind not in "biuf":
        raise wrong
    return shape, fortran, dtype


@lru_cache(64)
def _head(shape: tuple[int, ...], descr: str) -> bytes:
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": descr})
    return file.getvalue()
