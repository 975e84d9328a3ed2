"""Checksums of pictures: to notice one that comes twice, and one that changed on its way.

They are computed outside all marks, after an answer's last token, and in some 50 us for 640x480: whatever a server
does then competes with the sending of the tokens, and a pause before it would let the processor fall asleep.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from s2a_bench.facts import Fact
from s2a_bench.frames.convert import to_rgb
from s2a_bench.types import Frame, Pixels

RGB_ENGINE = Fact("rgb_engine", "", "checksum of the engine's pixels")
"""What a server tells besides; it becomes a column of its own."""


def fingerprint(frame: Frame) -> int:
    """Return a checksum, of 52 bits, of a picture as it lies in memory."""
    return _checksum(frame.data)


def together(checksums: Iterable[int]) -> int:
    """Return one checksum, of 52 bits, of several in order; that of a single one is itself."""
    first, *others = checksums
    for each in others:
        first = ((first * _ODD + each) * _ODD) % 2**64 >> 12
    return first


def rgb_fingerprint(frame: Frame) -> int:
    """Return the checksum of the RGB that a direct conversion of the frame gives."""
    return _checksum(to_rgb(frame))


def _checksum(pixels: Pixels) -> int:
    """Weigh each word of eight bytes by an odd number of its own and add them up, modulo 2^64; fold to 52 bits.

    So any other word changes the sum, and so do words that change places. It is no defence against forgery.
    """
    data = pixels.reshape(-1)
    whole = data.size // 8 * 8
    words = data[:whole].view(np.uint64)
    tail = int.from_bytes(data[whole:].tobytes(), "little")
    total = int(np.dot(words, _weights(words.size))) + (tail + 1) * _ODD
    return ((total + data.size) * _ODD) % 2**64 >> 12


_ODD = 0x9E3779B97F4A7C15
"""2^64 over the golden ratio, as in Fibonacci hashing (Knuth, TAOCP 3, section 6.4)."""


@lru_cache(maxsize=4)
def _weights(size: int) -> NDArray[np.uint64]:
    weights: NDArray[np.uint64] = np.arange(size, dtype=np.uint64) * np.uint64(_ODD - 1) + np.uint64(1)
    return weights
