"""Read a GGUF file's header and check that the file is complete, without reading the weights.

llama.cpp detects a truncated language model, not a truncated mmproj, and logs its reasons; gguf-py takes 7 s for a
vocabulary of 300000, this a fraction of one. The layout is that of ggml's ``docs/gguf.md``, versions 2 and 3.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from s2a_bench import extras
from s2a_bench.errors import ModelError

MAGIC = b"GGUF"
_SCALARS = {0: "<B", 1: "<b", 2: "<H", 3: "<h", 4: "<I", 5: "<i", 6: "<f", 7: "<?", 10: "<Q", 11: "<q", 12: "<d"}
_STRING, _ARRAY = 8, 9
_MAX_DIMS = 4
_MAX_FIELDS, _MAX_TENSORS, _MAX_STRINGS = 2**16, 2**20, 2**24
"""Ten times the counts of the largest models; a damaged count must not be read for minutes."""

Value: TypeAlias = str | int | float | bool


@dataclass(frozen=True, slots=True)
class GgufHeader:
    path: Path
    fields: dict[str, Value]
    parameters: int
    """Numbers in all tensors."""

    @property
    def architecture(self) -> str:
        return str(self.fields.get("general.architecture", ""))

    @property
    def is_mmproj(self) -> bool:
        return self.architecture == "clip"

    @property
    def is_dummy(self) -> bool:
        return self.fields.get("s2a_bench.dummy") is True


class _Cursor:
    __slots__ = ("at", "data")

    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        self.at = 0

    def number(self, form: str) -> Any:
        (value,) = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return value

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise EOFError

    def string(self) -> str:
        size = self.number("<Q")
        start = self.at
        self.skip(size)
        return self.data[start : self.at].decode()

    def skip_array(self) -> None:
        kind, length = self.number("<I"), self.number("<Q")
        if kind == _STRING:
            for _ in range(_at_most(length, _MAX_STRINGS)):
                self.skip(self.number("<Q"))
        else:
            self.skip(length * struct.calcsize(_SCALARS[kind]))


def read_header(path: Path, flag: str) -> GgufHeader:
    """Read the header of ``path`` and check that every tensor lies within the file.

    Raises ModelError, which names ``flag``, if the file is missing, not GGUF, damaged or truncated.
    """
    try:
        if path.is_fifo() or path.is_char_device():  # opening a pipe would wait for its writer
            raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
        with path.open("rb") as file:
            if not os.fstat(file.fileno()).st_size:
                raise ModelError(f"{flag} {path}: not a GGUF file, it is empty; fetch it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                return _parse(path, data, flag)
    except FileNotFoundError:
        raise ModelError(f"{flag} {path}: no such file; check the path") from None
    except OSError as error:
        raise ModelError(f"{flag} {path}: cannot be read ({error.strerror or error}); check the path") from error
    except (struct.error, EOFError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
        raise ModelError(f"{flag} {path}: the GGUF header is damaged or cut short; fetch the file again") from error


def _parse(path: Path, data: mmap.mmap, flag: str) -> GgufHeader:
    if data[: len(MAGIC)] != MAGIC:
        raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
    cursor = _Cursor(data)
    cursor.skip(len(MAGIC))
    version = cursor.number("<I")
    if version not in (2, 3):
        raise ModelError(f"{flag} {path}: GGUF version {version} is not known (2 and 3 are); convert the model again")
    n_tensors, n_fields = _at_most(cursor.number("<Q"), _MAX_TENSORS), _at_most(cursor.number("<Q"), _MAX_FIELDS)
    fields: dict[str, Value] = {}
    for _ in range(n_fields):
        key, kind = cursor.string(), cursor.number("<I")
        if kind == _ARRAY:
            cursor.skip_array()
        else:
            fields[key] = cursor.string() if kind == _STRING else cursor.number(_SCALARS[kind])
    last, parameters = _tensors(cursor, n_tensors)
    alignment = int(fields.get("general.alignment", 32))
    end = -(-cursor.at // alignment) * alignment + last
    if end > len(data):
        raise ModelError(f"{flag} {path}: cut short, {len(data)} of {end} bytes are there; fetch the file again")
    return GgufHeader(path, fields, parameters)


def _tensors(cursor: _Cursor, count: int) -> tuple[int, int]:
    """Return the offset within the data of the last tensor's end, and the numbers in all tensors."""
    sizes = extras.require("gguf.constants", "model").GGML_QUANT_SIZES
    last = numbers = 0
    for _ in range(count):
        _name, n_dims = cursor.string(), cursor.number("<I")
        if n_dims > _MAX_DIMS:
            raise ValueError(n_dims)
        shape = [cursor.number("<Q") for _ in range(n_dims)]
        block, block_bytes = sizes[cursor.number("<I")]
        size = math.prod(shape)
        numbers += size
        last = max(last, cursor.number("<Q") + size // block * block_bytes)
    return last, numbers


def _at_most(count: int, most: int) -> int:
    if count > most:
        raise ValueError(count)
    return count
