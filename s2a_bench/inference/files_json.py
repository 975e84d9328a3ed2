"""Model files as the ``--json`` objects of `model fetch` and `model info`, and their schema, hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from s2a_bench.store.bounds import Count, Facts, about
from s2a_bench.store.manifest import present

if TYPE_CHECKING:
    from s2a_bench.inference.fetch import FetchedFile
    from s2a_bench.inference.gguf_info import GgufInfo, Vocabulary

Sha256 = Annotated[str, Facts(pattern="^[0-9a-f]{64}$")]
Scalars: TypeAlias = dict[str, str | float | bool]


@dataclass(frozen=True)
class Fetched:
    """One file that was fetched."""

    path: str
    bytes: Count
    sha256: Sha256
    resumed_at: Annotated[Count, about("Bytes that were there before; all of them where nothing was downloaded.")]


@dataclass(frozen=True)
class TypeShare:
    """How much of the file one tensor type takes."""

    kind: str
    tensors: Count
    parameters: Count
    bytes: Count


@dataclass(frozen=True)
class TensorGroup:
    """The same tensor of all layers (N in the name), with its shape, columns last."""

    name: str
    shape: list[Count]
    kinds: list[str]
    tensors: Count
    bytes: Count


@dataclass(frozen=True)
class SpecialToken:
    """A token with a role, as the end of an answer."""

    id: Count
    text: str


@dataclass(frozen=True)
class VocabularyJson:
    """How long the tokeniser's lists are, and which tokens are special, by their role."""

    tokens: Count
    merges: Count
    special: dict[str, SpecialToken]
    control: list[str]


@dataclass(frozen=True, kw_only=True)
class Info:
    """What is in a GGUF file."""

    path: str
    bytes: Count
    sha256: Annotated[Sha256 | None, about("Absent where it is neither asked for nor known.")] = None
    gguf_version: int
    architecture: Annotated[str, about("`clip` is an mmproj; empty where the file names none.")]
    mmproj: bool
    dummy: Annotated[bool, about("Random weights, written by `model dummy`.")]
    general: Annotated[Scalars, about("The file's general.* keys for people: name, license, ...")]
    file_type: Annotated[str | None, about("The mixture of types that was asked for, as Q4_K_M.")] = None
    parameters: Count
    types: list[TypeShare]
    groups: list[TensorGroup]
    settings: Annotated[
        Scalars, about("The architecture's keys without its name: context_length, vision.image_size, ...")
    ]
    tokenizer: Scalars
    vocabulary: VocabularyJson | None = None
    chat_template: str | None = None


def fetched_json(file: FetchedFile) -> dict[str, Any]:
    """Return a fetched file as plain data."""
    return present(Fetched(str(file.path), file.nbytes, file.sha256, file.resumed_at))


def info_json(info: GgufInfo, sha256: str | None) -> dict[str, Any]:
    """Return what is in a file as plain data; what it does not hold is an absent key."""
    own = {name: getattr(info, name) for name in Info.__annotations__ if hasattr(info, name) and name != "path"}
    own["types"] = [TypeShare(each.kind, each.tensors, each.parameters, each.nbytes) for each in info.types]
    own["groups"] = [
        TensorGroup(each.name, list(each.shape), list(each.kinds), each.tensors, each.nbytes) for each in info.groups
    ]
    own["vocabulary"] = info.vocabulary and _vocabulary(info.vocabulary)
    return present(Info(path=str(info.path), bytes=info.nbytes, sha256=sha256, **own))


def _vocabulary(vocabulary: Vocabulary) -> VocabularyJson:
    special = {role: SpecialToken(at, text) for role, (at, text) in vocabulary.special.items()}
    return VocabularyJson(vocabulary.tokens, vocabulary.merges, special, list(vocabulary.control))
