"""Read a GGUF file's header, and find out whether the file is complete, without llama.cpp and without its weights.

llama.cpp notices a truncated language model, not a truncated mmproj; and its reasons go to a log. The layout is
that of ggml's ``docs/gguf.md``, versions 2 and 3, little endian.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from s2a_bench.errors import ModelError

MAGIC = b"GGUF"
_SCALARS = {0: "<B", 1: "<b", 2: "<H", 3: "<h", 4: "<I", 5: "<i", 6: "<f", 7: "<?", 10: "<Q", 11: "<q", 12: "<d"}
_STRING, _ARRAY = 8, 9
_MAX_DIMS = 4

Value: TypeAlias = str | int | float | bool


@dataclass(frozen=True, slots=True)
class GgufHeader:
    """What the header says: its scalar and string keys (arrays are left out) and the number of tensors."""

    path: Path
    fields: dict[str, Value]
    n_tensors: int

    @property
    def architecture(self) -> str:
        """Return ``general.architecture``; `clip` is a vision tower with its projector."""
        return str(self.fields.get("general.architecture", ""))

    @property
    def is_mmproj(self) -> bool:
        """Tell whether this is a projector file and not a language model."""
        return self.architecture == "clip"

    @property
    def has_vision(self) -> bool:
        """Tell whether a projector file holds a vision tower."""
        return self.fields.get("clip.has_vision_encoder") is True

    @property
    def is_dummy(self) -> bool:
        """Tell whether our `model dummy` wrote the file."""
        return self.fields.get("s2a_bench.dummy") is True


class _Cursor:
    """A place in the mapped file; every read moves it."""

    __slots__ = ("at", "data")

    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        self.at = 0

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

    def skip_array(self) -> None:
        kind, count = self.integer("<I"), self.integer("<Q")
        if kind == _STRING:
            for _ in range(count):
                self.skip(self.integer("<Q"))
        elif kind in _SCALARS:
            self.skip(count * struct.calcsize(_SCALARS[kind]))
        else:
            raise ValueError(kind)


def read_header(path: Path, flag: str) -> GgufHeader:
    """Read the header of ``path`` and check that every tensor lies within the file.

    Raises ModelError, which names ``flag``, where the file is missing, no GGUF, damaged or cut short.
    """
    try:
        with path.open("rb") as file:
            if file.read(4) != MAGIC:
                raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                return _parse(path, data, flag)
    except FileNotFoundError:
        raise ModelError(f"{flag} {path}: no such file; check the path, or leave it out for the tiny dummy") from None
    except OSError as error:
        raise ModelError(f"{flag} {path}: cannot be read ({error.strerror or error}); check the path") from error
    except (struct.error, EOFError, ValueError, KeyError, OverflowError, MemoryError) as error:
        raise ModelError(f"{flag} {path}: the GGUF header is damaged or cut short; fetch the file again") from error


def _parse(path: Path, data: mmap.mmap, flag: str) -> GgufHeader:
    cursor = _Cursor(data)
    cursor.skip(len(MAGIC))
    version = cursor.integer("<I")
    if version not in (2, 3):
        raise ModelError(f"{flag} {path}: GGUF version {version} is not known (2 and 3 are); convert the model again")
    n_tensors, n_fields = cursor.integer("<Q"), cursor.integer("<Q")
    fields: dict[str, Value] = {}
    for _ in range(n_fields):
        key, kind = cursor.string(), cursor.integer("<I")
        if kind == _ARRAY:
            cursor.skip_array()
        else:
            fields[key] = cursor.string() if kind == _STRING else cursor.scalar(_SCALARS[kind])
    end = _end_of_tensors(cursor, n_tensors, int(fields.get("general.alignment", 32)))
    if end > len(data):
        raise ModelError(f"{flag} {path}: cut short, {len(data)} of {end} bytes are there; fetch the file again")
    return GgufHeader(path, fields, n_tensors)


def _end_of_tensors(cursor: _Cursor, n_tensors: int, alignment: int) -> int:
    """Return the offset at which the last tensor ends."""
    from gguf.constants import GGML_QUANT_SIZES

    last = 0
    for _ in range(n_tensors):
        cursor.string()
        n_dims = cursor.integer("<I")
        if n_dims > _MAX_DIMS:
            raise ValueError(n_dims)
        elements = 1
        for _ in range(n_dims):
            elements *= cursor.integer("<Q")
        block, block_bytes = GGML_QUANT_SIZES[cursor.integer("<I")]
        last = max(last, cursor.integer("<Q") + elements // block * block_bytes)
    return -(-cursor.at // alignment) * alignment + last
