"""Read a GGUF file's header, and find out whether the file is complete, without llama.cpp and without its weights.

llama.cpp notices a truncated language model, not a truncated mmproj; and its reasons go to a log. The layout is
that of ggml's ``docs/gguf.md``, versions 2 and 3, little endian.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

from s2a_bench import extras
from s2a_bench.errors import ModelError

MAGIC = b"GGUF"
_SCALARS = {0: "<B", 1: "<b", 2: "<H", 3: "<h", 4: "<I", 5: "<i", 6: "<f", 7: "<?", 10: "<Q", 11: "<q", 12: "<d"}
_STRING, _ARRAY = 8, 9
_MAX_DIMS = 4
_MAX_FIELDS, _MAX_TENSORS, _MAX_STRINGS = 2**16, 2**20, 2**24
"""Ten times what the largest models have; a damaged count must not be read for minutes."""

Value: TypeAlias = str | int | float | bool


class TensorInfo(NamedTuple):
    """One tensor as the header lists it; ``shape`` in GGUF's order (columns first), ``kind`` a ``ggml_type``."""

    name: str
    shape: tuple[int, ...]
    kind: int
    nbytes: int


class ArrayPlace(NamedTuple):
    """Where an array lies in the file: the type of its items, how many there are, the offset of the first."""

    kind: int
    length: int
    at: int


@dataclass(frozen=True, slots=True)
class GgufHeader:
    """What the header says: its scalar and string keys, where its arrays lie, and its tensors without their data."""

    path: Path
    version: int
    nbytes: int
    """Size of the whole file."""
    fields: dict[str, Value]
    arrays: dict[str, ArrayPlace]
    tensors: tuple[TensorInfo, ...]

    @property
    def architecture(self) -> str:
        """Return ``general.architecture``; `clip` is a vision tower with its projector."""
        return str(self.fields.get("general.architecture", ""))

    @property
    def is_mmproj(self) -> bool:
        """Return whether this is a projector file and not a language model."""
        return self.architecture == "clip"

    @property
    def has_vision(self) -> bool:
        """Return whether a projector file holds a vision tower."""
        return self.fields.get("clip.has_vision_encoder") is True

    @property
    def is_dummy(self) -> bool:
        """Return whether our `model dummy` wrote the file."""
        return self.fields.get("s2a_bench.dummy") is True


class _Cursor:
    """A place in the mapped file; every read moves it."""

    __slots__ = ("at", "data")

    def __init__(self, data: mmap.mmap, at: int = 0) -> None:
        self.data = data
        self.at = at

    def scalar(self, form: str) -> int | float | bool:
        value: int | float | bool = struct.unpack_from(form, self.data, self.at)[0]
        self.at += struct.calcsize(form)
        return value

    def integer(self, form: str) -> int:
        return int(self.scalar(form))

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise EOFError

    def string(self) -> str:
        size = self.integer("<Q")
        start = self.at
        self.skip(size)
        return self.data[start : self.at].decode()

    def skip_array(self) -> ArrayPlace:
        place = ArrayPlace(self.integer("<I"), self.integer("<Q"), self.at)
        if place.kind == _STRING:
            for _ in range(_at_most(place.length, _MAX_STRINGS)):
                self.skip(self.integer("<Q"))
        else:
            self.skip(place.length * struct.calcsize(_SCALARS[place.kind]))
        return place


def read_header(path: Path, flag: str) -> GgufHeader:
    """Read the header of ``path`` and check that every tensor lies within the file.

    Raises ModelError, which names ``flag``, where the file is missing, no GGUF, damaged or cut short.
    """
    with _mapped(path, flag) as data:
        if data[: len(MAGIC)] != MAGIC:
            raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
        return _parse(path, data, flag)


@contextmanager
def _mapped(path: Path, flag: str) -> Iterator[mmap.mmap]:
    """Map a file, and turn what reading it runs into into a ModelError."""
    try:
        if path.is_fifo() or path.is_char_device():
            raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
        with path.open("rb") as file:
            if not os.fstat(file.fileno()).st_size:
                raise ModelError(f"{flag} {path}: not a GGUF file, it is empty; fetch it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield data
    except FileNotFoundError:
        raise ModelError(f"{flag} {path}: no such file; check the path") from None
    except OSError as error:
        raise ModelError(f"{flag} {path}: cannot be read ({error.strerror or error}); check the path") from error
    except (struct.error, EOFError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
        raise ModelError(f"{flag} {path}: the GGUF header is damaged or cut short; fetch the file again") from error


def _parse(path: Path, data: mmap.mmap, flag: str) -> GgufHeader:
    cursor = _Cursor(data)
    cursor.skip(len(MAGIC))
    version = cursor.integer("<I")
    if version not in (2, 3):
        raise ModelError(f"{flag} {path}: GGUF version {version} is not known (2 and 3 are); convert the model again")
    n_tensors, n_fields = _at_most(cursor.integer("<Q"), _MAX_TENSORS), _at_most(cursor.integer("<Q"), _MAX_FIELDS)
    fields: dict[str, Value] = {}
    arrays: dict[str, ArrayPlace] = {}
    for _ in range(n_fields):
        key, kind = cursor.string(), cursor.integer("<I")
        if kind == _ARRAY:
            arrays[key] = cursor.skip_array()
        else:
            fields[key] = cursor.string() if kind == _STRING else cursor.scalar(_SCALARS[kind])
    tensors, last = _tensors(cursor, n_tensors)
    alignment = int(fields.get("general.alignment", 32))
    end = -(-cursor.at // alignment) * alignment + last
    if end > len(data):
        raise ModelError(f"{flag} {path}: cut short, {len(data)} of {end} bytes are there; fetch the file again")
    return GgufHeader(path, version, len(data), fields, arrays, tensors)


def _tensors(cursor: _Cursor, count: int) -> tuple[tuple[TensorInfo, ...], int]:
    """Return the tensors, and the offset within the data at which the last of them ends."""
    sizes = extras.require("gguf.constants", "model").GGML_QUANT_SIZES
    tensors, last = [], 0
    for _ in range(count):
        name, n_dims = cursor.string(), cursor.integer("<I")
        if n_dims > _MAX_DIMS:
            raise ValueError(n_dims)
        shape = tuple(cursor.integer("<Q") for _ in range(n_dims))
        kind = cursor.integer("<I")
        block, block_bytes = sizes[kind]
        nbytes = math.prod(shape) // block * block_bytes
        tensors.append(TensorInfo(name, shape, kind, nbytes))
        last = max(last, cursor.integer("<Q") + nbytes)
    return tuple(tensors), last


def _at_most(count: int, most: int) -> int:
    if count > most:
        raise ValueError(count)
    return count


def read_array(header: GgufHeader, key: str, flag: str) -> list[Value]:
    """Read one array of a file; empty where it has no such key. Raises ModelError, which names ``flag``."""
    place = header.arrays.get(key)
    if place is None:
        return []
    with _mapped(header.path, flag) as data:
        cursor = _Cursor(data, place.at)
        if place.kind == _STRING:
            return [cursor.string() for _ in range(place.length)]
        items = f"<{place.length}{_SCALARS[place.kind][1:]}"
        return list(struct.unpack_from(items, data, place.at))
