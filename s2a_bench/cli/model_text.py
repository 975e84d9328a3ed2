"""How `model info` shows a GGUF file to people: text and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import RenderableType

    from s2a_bench.inference.gguf_info import GgufInfo, Vocabulary

_TEMPLATE_CHARACTERS = 300
_CONTROL_TOKENS = 24


def renderables(info: GgufInfo, sha256: str | None) -> list[RenderableType]:
    """Return what to print, in order."""
    parts: list[RenderableType] = ["\n".join(_head(info, sha256)), _types(info), _groups(info)]
    parts.append("settings: " + _clean(", ".join(f"{key} {value}" for key, value in info.settings.items())))
    if info.vocabulary is not None:
        parts.append("\n".join(_vocabulary(info.vocabulary, info.tokenizer)))
    if info.chat_template is not None:
        text, cut = info.chat_template, len(info.chat_template) > _TEMPLATE_CHARACTERS
        more = f" ... ({len(text)} characters; --json has all of them)" if cut else ""
        parts.append(f"chat template: {text[:_TEMPLATE_CHARACTERS]!r}{more}")
    return parts


def _clean(text: object) -> str:
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in str(text))


def _head(info: GgufInfo, sha256: str | None) -> list[str]:
    kind = "mmproj (vision tower and projector)" if info.mmproj else "language model"
    lines = [
        f"{info.path}",
        f"{kind}, architecture {_clean(info.architecture) or 'not given'}" + (", DUMMY WEIGHTS" if info.dummy else ""),
    ]
    lines += [f"{key}: {_clean(value)}" for key, value in info.general.items()]
    size = f"{info.nbytes / 1e9:.3f} GB, {info.parameters:,} parameters, GGUF version {info.gguf_version}"
    lines.append(size + (f", file type {info.file_type}" if info.file_type else ""))
    lines.append(f"sha256: {sha256}" if sha256 else "sha256: not computed; --hash computes it")
    return lines


def _types(info: GgufInfo) -> RenderableType:
    from rich.table import Table

    table = Table("type", title="weights by type", title_justify="left")
    for name in ("tensors", "parameters", "MB", "bits/weight"):
        table.add_column(name, justify="right")
    for share in info.types:
        bits = f"{share.nbytes * 8 / share.parameters:.2f}" if share.parameters else ""
        table.add_row(share.kind, str(share.tensors), f"{share.parameters:,}", f"{share.nbytes / 1e6:,.1f}", bits)
    return table


def _groups(info: GgufInfo) -> RenderableType:
    from rich.table import Table

    table = Table("tensor", "shape", "type", title="weights by tensor (N: the layer)", title_justify="left")
    for name in ("tensors", "MB"):
        table.add_column(name, justify="right")
    for group in info.groups:
        shape = " x ".join(map(str, group.shape))
        table.add_row(
            _clean(group.name), shape, ", ".join(group.kinds), str(group.tensors), f"{group.nbytes / 1e6:,.1f}"
        )
    return table


def _vocabulary(vocabulary: Vocabulary, tokenizer: dict[str, Any]) -> list[str]:
    named = ", ".join(f"{key} {value}" for key, value in tokenizer.items())
    special = ", ".join(f"{role} {at} {text!r}" for role, (at, text) in vocabulary.special.items())
    control = vocabulary.control
    more = f" ... ({len(control)} in all)" if len(control) > _CONTROL_TOKENS else ""
    return [
        f"vocabulary: {vocabulary.tokens} tokens, {vocabulary.merges} merges; tokeniser {_clean(named)}",
        f"special tokens: {special or 'none named'}",
        f"control tokens: {_clean(' '.join(control[:_CONTROL_TOKENS])) or 'none'}{more}",
    ]
