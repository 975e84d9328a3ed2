"""Random numbers from a seed and the text of a key, independent of what else runs, and in which order."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class Verbatim(str):
    """A part of a key that is not quoted: the text of a record, fixed even if its class is renamed."""

    __slots__ = ()
    __repr__ = str.__str__


def generator(seed: int, *key: str) -> np.random.Generator:
    """Return the random generator of one cell, which ``key`` names."""
    import numpy as np

    return np.random.default_rng([seed, zlib.crc32(repr(key).encode())])
