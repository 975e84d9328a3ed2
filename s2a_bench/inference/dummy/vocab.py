"""Vocabularies: the 256 bytes, merges of letters, special tokens."""

from __future__ import annotations

import math
import string
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

NORMAL, CONTROL = 1, 3
"""Token types of GGUF (``gguf.TokenType``)."""

FULL_SIZE = 151_666
"""The number of MiniCPM-V 2.6's tokens: Qwen2's byte-level ones, then `SPECIAL`."""

FULL_UNKNOWN = 128_244
"""MiniCPM-V 2.6 keeps ``<unk>`` within Qwen2's range."""

_LETTERS = "etaoinshrdlcumwfgypbvkjxqz"

_QWEN_SPECIAL = ("<|endoftext|>", "<|im_start|>", "<|im_end|>")
_IMAGE_SPECIAL = tuple(
    mark
    for name in ("image", "ref", "box", "quad", "point", "slice", "image_id")
    for mark in (f"<{name}>", f"</{name}>")
)
_RESERVED = tuple(f"<|reserved_special_token_{index}|>" for index in range(6))
TEXT = frozenset(string.ascii_letters + string.digits + string.punctuation + " \n")
SPECIAL = _QWEN_SPECIAL + _IMAGE_SPECIAL + _RESERVED


@dataclass(frozen=True, slots=True)
class Vocab:
    """Tokens by index with their GGUF types, merges by rank, and the indices of tokens with a role."""

    tokens: list[str]
    types: list[int]
    merges: list[str]
    pad: int
    bos: int
    eos: int
    unknown: int

    def texts(self) -> list[bool]:
        """Return for each token whether it is a text: no control token, no byte of a longer character."""
        unreadable = {name for byte, name in byte_names().items() if chr(byte) not in TEXT}
        return [kind == NORMAL and token not in unreadable for token, kind in zip(self.tokens, self.types, strict=True)]


def byte_names() -> dict[int, str]:
    """Return GPT-2's printable character for each of the 256 bytes (``bytes_to_unicode``), in GPT-2's order."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    others = [byte for byte in range(256) if byte not in printable]
    return {byte: chr(byte) for byte in printable} | {byte: chr(256 + index) for index, byte in enumerate(others)}


def make_vocab(*, full: bool, size: int = FULL_SIZE, special: Sequence[str] = SPECIAL) -> Vocab:
    """Return the 256 bytes, merges, and ``special``, which begins with padding, begin and end; ``size`` if ``full``."""
    minicpm = special is SPECIAL
    tokens = list(byte_names().values())
    # \u0120 stands for a space, \u010a for a new line: MTMD looks up the empty line, which MiniCPM-V 2.6 does not need
    merges = [] if minicpm else ["\u010a \u010a"]
    # at least one for llama.cpp
    merges += _letter_merges(size - len(special) - len(tokens) - len(merges)) if full else ["\u0120 t"]
    tokens += [merge.replace(" ", "") for merge in merges]
    types = [NORMAL] * len(tokens) + [CONTROL] * len(special)
    first = unknown = len(tokens)
    tokens += special
    if minicpm and full:
        unknown = FULL_UNKNOWN
        tokens[unknown], types[unknown] = "<unk>", CONTROL
    elif minicpm:
        unknown = len(tokens)
        tokens.append("<unk>")
        types.append(CONTROL)
    return Vocab(tokens, types, merges, pad=first, bos=first + 1, eos=first + 2, unknown=unknown)


def _letter_merges(count: int) -> list[str]:
    """Return ``count`` merges, the shorter texts first: pairs of letters, the same after a space, triples, fours."""
    pairs = [first + second for first, second in product(_LETTERS, repeat=2)]
    merges = [f"{pair[0]} {pair[1]}" for pair in pairs]
    merges += [f"\u0120 {pair}" for pair in pairs]
    merges += [f"{pair} {letter}" for pair, letter in product(pairs, _LETTERS)]
    # the commonest pairs with each other, so that English text takes about as few tokens as it does in Qwen2
    side = math.isqrt(count - len(merges) - 1) + 1
    merges += [f"{first} {second}" for first, second in product(pairs[:side], repeat=2)]
    return merges[:count]
