"""Checksums of pictures, to detect a repeated picture and one that changed between camera and engine.

They are computed outside all marks, after an answer's last token, and take some 50 us for 640x480: a server that
computes then competes with the sending of the tokens, and a pause before it would let the processor fall asleep.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from s2a_bench.facts import Fact
from s2a_bench.types import Pixels

RGB_ENGINE = Fact("rgb_engine", "", "checksum of the engine's pixels")
"""A server's fact that becomes a column."""


def together(checksums: Iterable[int]) -> int:
    """Combine several checksums, in order, to one of 52 bits; a single one stays as it is."""
    first, *others = checksums
    for each in others:
        first = ((first * _ODD + each) * _ODD) % 2**64 >> 12
    return first


def fingerprint(pixels: Pixels) -> int:
    """Weight each group of eight bytes by a different odd number and sum, modulo 2^64; fold to 52 bits.

    A changed group changes the sum, and so do groups that change places. It does not protect against forgery.
    """
    data = pixels.reshape(-1)
    whole = data.size // 8 * 8
    groups = data[:whole].view(np.uint64)
    tail = int.from_bytes(data[whole:].tobytes(), "little")
    total = int(np.dot(groups, _weights(groups.size))) + (tail + 1) * _ODD
    return ((total + data.size) * _ODD) % 2**64 >> 12


_ODD = 0x9E3779B97F4A7C15
"""2^64 over the golden ratio, as in Fibonacci hashing (Knuth, TAOCP 3, section 6.4)."""


@lru_cache(maxsize=4)
def _weights(size: int) -> NDArray[np.uint64]:
    weights: NDArray[np.uint64] = np.arange(size, dtype=np.uint64) * np.uint64(_ODD - 1) + np.uint64(1)
    return weights
