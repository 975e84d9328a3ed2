"""Tensors of random numbers, drawn as bytes of each type's blocks."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Kind: TypeAlias = Literal["f32", "f16", "q8_0", "q4_0", "q6_k"]
Bytes: TypeAlias = NDArray[np.uint8]

PART_BYTES = 1 << 24

_F16_SPREAD = math.sqrt(7 / 3)  # of a number uniform in +-[1, 2)
_Q4_SPREAD = math.sqrt((16**2 - 1) / 12)
_Q6_SPREAD = math.sqrt((64**2 - 1) / 12)
_Q8_SPREAD = math.sqrt((256**2 - 1) / 12)
_Q6_SCALE = 8  # keeps the half-precision factor beside it a normal number


@dataclass(frozen=True, slots=True)
class Tensor:
    """One tensor: its shape in numpy's order (columns last); a ``value``, or one for each, if it is not random.

    The rows ``blank`` are 0; such a tensor is drawn in one part.
    """

    name: str
    shape: tuple[int, ...]
    kind: Kind = "f32"
    value: float | Sequence[float] | None = None
    blank: Sequence[int] = ()

    @property
    def nbytes(self) -> int:
        block, size, _ = KINDS[self.kind]
        return math.prod(self.shape) // block * size

    @property
    def spread(self) -> float:
        return 1 / math.sqrt(math.prod(self.shape[1:])) if len(self.shape) > 1 else 0.02

    def parts(self) -> Iterator[Bytes]:
        block, size, draw = KINDS[self.kind]
        left = math.prod(self.shape) // block
        generator = np.random.Generator(np.random.SFC64([0, zlib.crc32(self.name.encode())]))
        while left:
            blocks = left if self.blank else min(left, PART_BYTES // size)
            left -= blocks
            if self.value is None:
                words = generator.integers(0, 2**64 - 1, -(-blocks * size // 8), np.uint64, endpoint=True)
                part = draw(words.view(np.uint8)[: blocks * size], self.spread)
                if self.blank:  # bytes of 0 are numbers of 0 in every type
                    part.reshape(self.shape[0], -1)[self.blank] = 0
                yield part
            else:
                yield np.broadcast_to(np.asarray(self.value, _FLOATS[self.kind]), blocks).copy().view(np.uint8)


def _f32(raw: Bytes, spread: float) -> Bytes:
    numbers = raw.view("<i4").astype("<f4") * np.float32(spread * math.sqrt(3) / 2**31)
    return numbers.view(np.uint8)


def _f16(raw: Bytes, spread: float) -> Bytes:
    # sign and mantissa stay random, the exponent is set: no conversion, which would take minutes for 15 GB
    exponent = 15 + round(math.log2(spread / _F16_SPREAD))
    halves = raw.view("<u2")
    halves &= 0x83FF
    halves |= exponent << 10
    return raw


def _set_factor(raw: Bytes, layout: list[Any], factor: float) -> Bytes:
    """Set a block's factor, ``d``, negated in every second block: asymmetric codes then average to 0."""
    factors = raw.view(layout)["d"]
    factors[0::2], factors[1::2] = factor, -factor
    return raw


def _q8_0(raw: Bytes, spread: float) -> Bytes:
    return _set_factor(raw, [("d", "<f2"), ("q", "i1", 32)], spread / _Q8_SPREAD)


def _q4_0(raw: Bytes, spread: float) -> Bytes:
    return _set_factor(raw, [("d", "<f2"), ("q", "u1", 16)], spread / _Q4_SPREAD)


def _q6_k(raw: Bytes, spread: float) -> Bytes:
    layout: list[Any] = [("ql", "u1", 128), ("qh", "u1", 64), ("scales", "i1", 16), ("d", "<f2")]
    raw.view(layout)["scales"] = _Q6_SCALE
    return _set_factor(raw, layout, spread / _Q6_SPREAD / _Q6_SCALE)


KINDS: dict[Kind, tuple[int, int, Callable[[Bytes, float], Bytes]]] = {
    "f32": (1, 4, _f32),
    "f16": (1, 2, _f16),
    "q8_0": (32, 34, _q8_0),
    "q4_0": (32, 18, _q4_0),
    "q6_k": (256, 210, _q6_k),
}
"""Tensor type -> (numbers in a block, bytes of a block, function that turns random bytes into blocks)."""

_FLOATS: dict[Kind, str] = {"f32": "<f4", "f16": "<f2"}
