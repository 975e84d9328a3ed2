"""Arrays as NumPy writes them to files (format 1.0 and later), without a copy, and bounded: nothing is ever unpickled.

`PictureFile` holds a file before its pixels, so that a conversion writes them where they will be sent from.
"""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.messagepack import array_in
from s2a_bench.types import Pixels

HEAD: Final = 4096
"""Bytes of the longest header that is read; NumPy's own take 128."""
BEFORE: Final = 128
"""Bytes of the header of a picture, and of most."""
PREFIX: Final = {b"\x01\x00": 10, b"\x02\x00": 12, b"\x03\x00": 12}
"""Version -> bytes before the header's text: the magic, the version, the text's length."""


class PictureFile:
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


def file_of(array: NDArray[Any]) -> bytes:
    solid = np.ascontiguousarray(array)
    return b"".join((_head(array.shape, solid.dtype.str), solid.reshape(-1).view(np.uint8).data))


def array_of(data: Any) -> NDArray[Any]:
    """Return the read-only array in a file, without copying it.

    Raises RequestFailed for what is no such file, for other than numbers, and where the size is not that of the shape.
    """
    if not isinstance(data, bytes):
        raise RequestFailed(f"an array whose as_npy is {type(data).__name__}, not bytes")
    start, shape, fortran, dtype = _read_head(_head_in(data))
    return array_in(data, shape, dtype, start, fortran=fortran)


def _head_in(data: bytes) -> bytes:
    version = data[6:8]
    prefix = PREFIX.get(version, 0) if data.startswith(npy.MAGIC_PREFIX) else 0
    if not prefix or len(data) < prefix:
        raise RequestFailed(f"{len(data)} bytes that are no NumPy file")
    length = int.from_bytes(data[8:prefix], "little")
    if length > HEAD or len(data) < prefix + length:
        raise RequestFailed(f"a NumPy file whose header has {length} bytes")
    return data[: prefix + length]


@lru_cache(64)
def _read_head(head: bytes) -> tuple[int, tuple[int, ...], bool, np.dtype[Any]]:
    """Return where the array begins, its shape, whether it is in Fortran's order, and its type."""
    file, wrong = io.BytesIO(head), RequestFailed(f"a NumPy file of {head[10:90]!r}; numbers are taken, nothing else")
    read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
    try:
        shape, fortran, dtype = read(file)
    except Exception as error:  # NumPy's reader raises whatever Python's tokenizer does
        raise wrong from error
    if dtype.kind not in "biuf":
        raise wrong
    return len(head), shape, fortran, dtype


@lru_cache(64)
def _head(shape: tuple[int, ...], descr: str) -> bytes:
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": descr})
    return file.getvalue()
