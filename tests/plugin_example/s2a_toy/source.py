"""The frame source `toy-stripes`: a pattern that moves by one pixel a frame, so that no two frames are alike."""

from __future__ import annotations

import numpy as np
from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError
from s2a_bench.frames import check_size
from s2a_bench.types import Encoding, Frame


class Stripes:
    """Grey stripes as bgr8."""

    name = "toy-stripes"
    encoding: Encoding = "bgr8"
    where = ""

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:
        """Draw the pattern once; each frame is a part of it."""
        del where, fps
        check_size(width, height)
        self.width, self.height = width, height
        noise = np.random.default_rng(seed).integers(0, 256, (height, 4 * width, 1), np.uint8)
        self._pattern = np.repeat(noise, 3, axis=2)
        self._index = 0
        self._closed = False

    def read(self) -> Frame:
        """Return the next frame; raises SourceError once closed."""
        if self._closed:
            raise SourceError("`source`: toy-stripes is closed")
        first = self._index % (3 * self.width)
        data = self._pattern[:, first : first + self.width].copy()
        frame = Frame(self._index, now_ns(), self.width, self.height, "bgr8", data)
        self._index += 1
        return frame

    def close(self) -> None:
        """Be closed."""
        self._closed = True
