"""Say what is in a GGUF file: shapes, types, vision tower, vocabulary, template; from its header, not its weights.

gguf-py's own reader makes an array of each of 300000 vocabulary entries and takes 7 s; this takes a fraction of one.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from s2a_bench import extras
from s2a_bench.inference.gguf_file import GgufHeader, TensorInfo, Value, read_array, read_header

_CONTROL = 3
"""``gguf.TokenType.CONTROL``."""

_TOKENIZER = "tokenizer."
_TOKENS = "tokenizer.ggml.tokens"
_TYPES = "tokenizer.ggml.token_type"
_MERGES = "tokenizer.ggml.merges"
_SPECIAL = re.compile(r"tokenizer\.ggml\.(\w+)_token_id")
_CHAT_TEMPLATE = "tokenizer.chat_template"
_GENERAL = ("name", "basename", "size_label", "description", "license", "author", "organization", "version", "url")
"""Keys below ``general.`` that are shown as they are; the others are shown in other words, or say nothing to people."""


@dataclass(frozen=True, slots=True)
class TypeShare:
    """How much of the file one tensor type takes."""

    kind: str
    tensors: int
    parameters: int
    nbytes: int


@dataclass(frozen=True, slots=True)
class TensorGroup:
    """Tensors of one name, but for the layer's number, and of one shape (as numpy writes it, columns last)."""

    name: str
    shape: tuple[int, ...]
    kinds: tuple[str, ...]
    tensors: int
    nbytes: int


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """The tokeniser's lists: how long they are and which tokens are special."""

    tokens: int
    merges: int
    special: dict[str, tuple[int, str]]
    """Role (bos, eos, ...) -> number and text."""
    control: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class GgufInfo:
    """What `describe` finds; a fact that the file does not hold is None or absent."""

    path: Path
    nbytes: int
    gguf_version: int
    architecture: str
    mmproj: bool
    dummy: bool
    general: dict[str, Value]
    file_type: str | None
    parameters: int
    types: tuple[TypeShare, ...]
    groups: tuple[TensorGroup, ...]
    settings: dict[str, Value]
    """The architecture's scalar keys without its name: context_length, block_count, vision.image_size, ..."""
    tokenizer: dict[str, Value]
    vocabulary: Vocabulary | None
    chat_template: str | None


def describe(path: Path, flag: str) -> GgufInfo:
    """Read a language model's or an mmproj's header; raises ModelError, which names ``flag``, as `read_header` does."""
    header = read_header(path, flag)
    fields = header.fields
    own = f"{header.architecture}."
    return GgufInfo(
        path=path,
        nbytes=header.nbytes,
        gguf_version=header.version,
        architecture=header.architecture,
        mmproj=header.is_mmproj,
        dummy=header.is_dummy,
        general={key: _plain(fields[f"general.{key}"]) for key in _GENERAL if f"general.{key}" in fields},
        file_type=_file_type(fields.get("general.file_type")),
        parameters=sum(math.prod(tensor.shape) for tensor in header.tensors),
        types=_types(header.tensors),
        groups=_groups(header.tensors),
        settings={key.removeprefix(own): _plain(value) for key, value in fields.items() if key.startswith(own)},
        tokenizer={
            key: _plain(fields[f"tokenizer.ggml.{key}"])
            for key in ("model", "pre")
            if f"tokenizer.ggml.{key}" in fields
        },
        vocabulary=_vocabulary(header, flag),
        chat_template=str(fields[_CHAT_TEMPLATE]) if _CHAT_TEMPLATE in fields else None,
    )


def _plain(value: Value) -> Value:
    """Write a float of single precision as it was meant (1e-06); what is no number becomes text, as JSON has none."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.7g}") if math.isfinite(value) else str(value)


def _file_type(number: Value | None) -> str | None:
    """Name the mixture of types that the converter or ``llama-quantize`` was asked for."""
    kinds = extras.require("gguf.constants", "model").LlamaFileType
    names = {int(kind): kind.name.removeprefix("MOSTLY_").removeprefix("ALL_") for kind in kinds}
    return names.get(int(number)) if isinstance(number, int) else None


def _type_name(kind: int) -> str:
    return str(extras.require("gguf.constants", "model").GGMLQuantizationType(kind).name)


def _types(tensors: Sequence[TensorInfo]) -> tuple[TypeShare, ...]:
    """Add up by type, the largest first."""
    shares = []
    for kind in {tensor.kind for tensor in tensors}:
        own = [tensor for tensor in tensors if tensor.kind == kind]
        parameters = sum(math.prod(tensor.shape) for tensor in own)
        shares.append(TypeShare(_type_name(kind), len(own), parameters, sum(tensor.nbytes for tensor in own)))
    return tuple(sorted(shares, key=lambda share: (-share.nbytes, share.kind)))


def _groups(tensors: Sequence[TensorInfo]) -> tuple[TensorGroup, ...]:
    """Put the same tensor of all layers together, in the file's order."""
    members: dict[tuple[str, tuple[int, ...]], list[TensorInfo]] = {}
    for tensor in tensors:
        members.setdefault((re.sub(r"\.\d+\.", ".N.", tensor.name), tensor.shape[::-1]), []).append(tensor)
    return tuple(
        TensorGroup(
            name,
            shape,
            tuple(_type_name(kind) for kind, _ in Counter(tensor.kind for tensor in own).most_common()),
            len(own),
            sum(tensor.nbytes for tensor in own),
        )
        for (name, shape), own in members.items()
    )


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
        special={role: (at, texts[at]) for role, at in roles.items() if 0 <= at < len(texts)},
        control=tuple(
            text for text, kind in zip(texts, read_array(header, _TYPES, flag), strict=False) if kind == _CONTROL
        ),
    )
