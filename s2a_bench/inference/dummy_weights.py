"""Random weights as bytes: each tensor type's blocks are drawn directly, nothing is quantised from floats.

The bits are drawn from a generator of 64-bit integers, so that a seed gives the same bytes with every numpy. Only
the spread matters: a matrix has about ``1 / sqrt(columns)``, so that activations keep their size through the layers.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Kind: TypeAlias = Literal["f32", "f16", "q8_0", "q4_0", "q6_k"]
Bytes: TypeAlias = NDArray[np.uint8]

CHUNK_BYTES = 1 << 24

_F16_SPREAD = math.sqrt(7 / 3)  # of a number uniform in +-[1, 2)
_Q4_SPREAD = math.sqrt((16**2 - 1) / 12)
_Q6_SPREAD = math.sqrt((64**2 - 1) / 12)
_Q8_SPREAD = math.sqrt((256**2 - 1) / 12)
_Q6_SCALE = 8  # keeps the half-precision factor beside it a normal number


@dataclass(frozen=True, slots=True)
class Tensor:
    """One tensor: its shape as numpy writes it (columns last); a ``value``, or one for each, where it is not random."""

    name: str
    shape: tuple[int, ...]
    kind: Kind = "f32"
    value: float | Sequence[float] | None = None

    @property
    def nbytes(self) -> int:
        """Return the size in the file."""
        block, size, _ = KINDS[self.kind]
        return math.prod(self.shape) // block * size

    @property
    def spread(self) -> float:
        """Return the standard deviation of the numbers."""
        return 1 / math.sqrt(math.prod(self.shape[1:])) if len(self.shape) > 1 else 0.02

    def chunks(self, seed: int) -> Iterator[Bytes]:
        """Yield the tensor's bytes; the same for the same seed and name."""
        block, size, draw = KINDS[self.kind]
        left = math.prod(self.shape) // block
        generator = np.random.Generator(np.random.SFC64([seed, zlib.crc32(self.name.encode())]))
        while left:
            blocks = min(left, CHUNK_BYTES // size)
            left -= blocks
            if self.value is None:
                yield draw(_random_bytes(generator, blocks * size), self.spread)
            else:
                yield np.broadcast_to(np.asarray(self.value, _FLOATS[self.kind]), blocks).copy().view(np.uint8)


def _random_bytes(generator: np.random.Generator, size: int) -> Bytes:
    words = generator.integers(0, 2**64 - 1, -(-size // 8), np.uint64, endpoint=True)
    return words.view(np.uint8)[:size]


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


def _alternating(blocks: NDArray[np.void], field: str, value: float) -> None:
    """Turn every second block's sign, so that codes that are not symmetric about 0 average to 0."""
    blocks[field][0::2] = value
    blocks[field][1::2] = -value


def _q8_0(raw: Bytes, spread: float) -> Bytes:
    _alternating(raw.view([("d", "<f2"), ("q", "i1", 32)]), "d", spread / _Q8_SPREAD)
    return raw


def _q4_0(raw: Bytes, spread: float) -> Bytes:
    _alternating(raw.view([("d", "<f2"), ("q", "u1", 16)]), "d", spread / _Q4_SPREAD)
    return raw


def _q6_k(raw: Bytes, spread: float) -> Bytes:
    blocks = raw.view([("ql", "u1", 128), ("qh", "u1", 64), ("scales", "i1", 16), ("d", "<f2")])
    blocks["scales"] = _Q6_SCALE
    _alternating(blocks, "d", spread / _Q6_SPREAD / _Q6_SCALE)
    return raw


KINDS: dict[Kind, tuple[int, int, Callable[[Bytes, float], Bytes]]] = {
    "f32": (1, 4, _f32),
    "f16": (1, 2, _f16),
    "q8_0": (32, 34, _q8_0),
    "q4_0": (32, 18, _q4_0),
    "q6_k": (256, 210, _q6_k),
}
"""Tensor type -> (numbers in a block, bytes of a block, what makes random bytes into blocks)."""

_FLOATS: dict[Kind, str] = {"f32": "<f4", "f16": "<f2"}
