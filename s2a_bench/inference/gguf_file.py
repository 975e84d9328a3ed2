"""Read a GGUF file's header, check that the file is complete, and describe its content, without reading the weights.

llama.cpp detects a truncated language model, not a truncated mmproj, and logs its reasons; gguf-py takes 7 s for a
vocabulary of 300000, this a fraction of one. The layout is that of ggml's ``docs/gguf.md``, versions 2 and 3.
"""

from __future__ import annotations

import math
import mmap
import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple, TypeAlias

from s2a_bench import extras
from s2a_bench.errors import ModelError
from s2a_bench.store.schema import Count, Facts, about

MAGIC = b"GGUF"
_SCALARS = {0: "<B", 1: "<b", 2: "<H", 3: "<h", 4: "<I", 5: "<i", 6: "<f", 7: "<?", 10: "<Q", 11: "<q", 12: "<d"}
_STRING, _ARRAY = 8, 9
_MAX_DIMS = 4
_MAX_FIELDS, _MAX_TENSORS, _MAX_STRINGS = 2**16, 2**20, 2**24
"""Ten times the counts of the largest models; a damaged count must not be read for minutes."""

_CONTROL = 3
"""``gguf.TokenType.CONTROL``."""

_TOKENS = "tokenizer.ggml.tokens"
_TYPES = "tokenizer.ggml.token_type"
_MERGES = "tokenizer.ggml.merges"
_SPECIAL = re.compile(r"tokenizer\.ggml\.(\w+)_token_id")
_CHAT_TEMPLATE = "tokenizer.chat_template"
_GENERAL = ("name", "basename", "size_label", "description", "license", "author", "organization", "version", "url")
"""Keys below ``general.`` that are shown unchanged; other fields replace the rest."""

Value: TypeAlias = str | int | float | bool


class TensorInfo(NamedTuple):
    """One tensor as the header lists it; ``shape`` in GGUF's order (columns first), ``kind`` a ``ggml_type``."""

    name: str
    shape: tuple[int, ...]
    kind: int
    nbytes: int


class ArrayPlace(NamedTuple):
    """The type of an array's items, their number, and the offset of the first in the file."""

    kind: int
    length: int
    at: int


@dataclass(frozen=True, slots=True)
class GgufHeader:
    """A header: scalar and string fields, the places of arrays, and tensors without their data."""

    path: Path
    version: int
    nbytes: int
    """Size of the file."""
    fields: dict[str, Value]
    arrays: dict[str, ArrayPlace]
    tensors: tuple[TensorInfo, ...]

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

    Raises ModelError, which names ``flag``, if the file is missing, no GGUF, damaged or truncated.
    """
    with _mapped(path, flag) as data:
        if data[: len(MAGIC)] != MAGIC:
            raise ModelError(f"{flag} {path}: not a GGUF file; give one that llama.cpp can load")
        return _parse(path, data, flag)


@contextmanager
def _mapped(path: Path, flag: str) -> Iterator[mmap.mmap]:
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
    """Return the tensors, and the offset within the data of the last one's end."""
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
    """Read one array of a file, empty if the key is absent. Raises ModelError, which names ``flag``."""
    place = header.arrays.get(key)
    if place is None:
        return []
    with _mapped(header.path, flag) as data:
        cursor = _Cursor(data, place.at)
        if place.kind == _STRING:
            return [cursor.string() for _ in range(place.length)]
        items = f"<{place.length}{_SCALARS[place.kind][1:]}"
        return list(struct.unpack_from(items, data, place.at))


Sha256 = Annotated[str, Facts(pattern="^[0-9a-f]{64}$")]
Scalars: TypeAlias = dict[str, str | float | bool]


@dataclass(frozen=True, slots=True)
class TypeShare:
    """The share of one tensor type in the file."""

    kind: str
    tensors: Count
    parameters: Count
    bytes: Count


@dataclass(frozen=True, slots=True)
class TensorGroup:
    """The same tensor of all layers (N in the name), with its shape, columns last."""

    name: str
    shape: list[Count]
    kinds: list[str]
    tensors: Count
    bytes: Count


@dataclass(frozen=True, slots=True)
class SpecialToken:
    """A token with a role, for instance the end of an answer."""

    id: Count
    text: str


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """The lengths of the tokeniser's lists, and the special tokens by their role."""

    tokens: Count
    merges: Count
    special: dict[str, SpecialToken]
    control: list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class GgufInfo:
    """The content of a GGUF file."""

    path: Path
    bytes: Count
    sha256: Annotated[Sha256 | None, about("Absent if it is neither requested nor known.")] = None
    gguf_version: int
    architecture: Annotated[str, about("`clip` is an mmproj; empty where the file names none.")]
    mmproj: bool
    dummy: Annotated[bool, about("Random weights, written by `model dummy`.")]
    general: Annotated[Scalars, about("The file's general.* keys for people: name, license, ...")]
    file_type: Annotated[str | None, about("The name of the mixture of types, as Q4_K_M.")] = None
    parameters: Count
    types: list[TypeShare]
    groups: list[TensorGroup]
    settings: Annotated[
        Scalars, about("The architecture's keys without its name: context_length, vision.image_size, ...")
    ]
    tokenizer: Scalars
    vocabulary: Vocabulary | None = None
    chat_template: str | None = None


def describe(path: Path, flag: str, sha256: Callable[[Path], str | None] = lambda _path: None) -> GgufInfo:
    """Read a language model's or an mmproj's header; raises ModelError, which names ``flag``, as `read_header` does."""
    header = read_header(path, flag)
    fields, own = header.fields, f"{header.architecture}."

    def below(prefix: str, keys: Iterable[str]) -> Scalars:
        return {key: _plain(fields[prefix + key]) for key in keys if prefix + key in fields}

    return GgufInfo(
        path=path,
        bytes=header.nbytes,
        sha256=sha256(path),
        gguf_version=header.version,
        architecture=header.architecture,
        mmproj=header.is_mmproj,
        dummy=header.is_dummy,
        general=below("general.", _GENERAL),
        file_type=_file_type(fields.get("general.file_type")),
        parameters=sum(math.prod(tensor.shape) for tensor in header.tensors),
        types=_types(header.tensors),
        groups=_groups(header.tensors),
        settings={key.removeprefix(own): _plain(value) for key, value in fields.items() if key.startswith(own)},
        tokenizer=below("tokenizer.ggml.", ("model", "pre")),
        vocabulary=_vocabulary(header, flag),
        chat_template=str(fields[_CHAT_TEMPLATE]) if _CHAT_TEMPLATE in fields else None,
    )


def _plain(value: Value) -> Value:
    """Round a float of single precision to its decimal form (1e-06); NaN and infinity become text, for JSON."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.7g}") if math.isfinite(value) else str(value)


def _file_type(number: Value | None) -> str | None:
    kinds = extras.require("gguf.constants", "model").LlamaFileType
    names = {int(kind): kind.name.removeprefix("MOSTLY_").removeprefix("ALL_") for kind in kinds}
    return names.get(int(number)) if isinstance(number, int) else None


def _type_name(kind: int) -> str:
    return str(extras.require("gguf.constants", "model").GGMLQuantizationType(kind).name)


def _types(tensors: Sequence[TensorInfo]) -> list[TypeShare]:
    shares = []
    for kind in {tensor.kind for tensor in tensors}:
        members = [tensor for tensor in tensors if tensor.kind == kind]
        parameters = sum(math.prod(tensor.shape) for tensor in members)
        shares.append(TypeShare(_type_name(kind), len(members), parameters, sum(each.nbytes for each in members)))
    return sorted(shares, key=lambda share: (-share.bytes, share.kind))


def _groups(tensors: Sequence[TensorInfo]) -> list[TensorGroup]:
    members: dict[tuple[str, tuple[int, ...]], list[TensorInfo]] = {}
    for tensor in tensors:
        members.setdefault((re.sub(r"\.\d+\.", ".N.", tensor.name), tensor.shape[::-1]), []).append(tensor)
    return [
        TensorGroup(
            name,
            list(shape),
            [_type_name(kind) for kind, _ in Counter(tensor.kind for tensor in group).most_common()],
            len(group),
            sum(tensor.nbytes for tensor in group),
        )
        for (name, shape), group in members.items()
    ]


def _vocabulary(header: GgufHeader, flag: str) -> Vocabulary | None:
    if _TOKENS not in header.arrays:
        return None
    texts = [str(text) for text in read_array(header, _TOKENS, flag)]
    roles = {
        found[1]: int(value)
        for key, value in header.fields.items()
        if (found := _SPECIAL.fullmatch(key)) and isinstance(value, int)
    }
    merges = header.arrays.get(_MERGES)
    return Vocabulary(
        tokens=len(texts),
        merges=merges.length if merges else 0,
        special={role: SpecialToken(at, texts[at]) for role, at in roles.items() if 0 <= at < len(texts)},
        control=[text for text, kind in zip(texts, read_array(header, _TYPES, flag), strict=False) if kind == _CONTROL],
    )
