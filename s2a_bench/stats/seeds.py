"""Random numbers from a seed and the text of a key: the same whatever else is run, in whatever order."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class Verbatim(str):
    """A part of a key that stands in it unquoted: the text of a record, fixed whatever its class is called later."""

    __slots__ = ()
    __repr__ = str.__str__


def generator(seed: int, *key: str) -> np.random.Generator:
    """Return the random generator of one cell, which ``key`` names."""
    import numpy as np

    return np.random.default_rng([seed, zlib.crc32(repr(key).encode())])
