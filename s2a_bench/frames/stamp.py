"""A stamp in the corner of every frame, so that no picture is sent twice: a server may cache its work on a picture.

The stamp is a hash of a nonce and the frame's index. Each run draws a new nonce, and adds the name of the cell for an
external server; the same nonce gives the same pictures.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import blake2b

import numpy as np

from s2a_bench.frames import FrameSource
from s2a_bench.types import Frame

SIDE = 8
"""Cells of the stamp in each direction, one bit each; 2x2 pixels are large enough to survive JPEG."""
BLACK, WHITE, GREY = 16, 235, 128
"""Luma of 0 and 1, and the chroma."""


class Stamped:
    """A source whose frames are stamped in their upper left 16x16 pixels; compressed frames stay unchanged."""

    def __init__(self, source: FrameSource, nonce: str) -> None:
        self.name, self.encoding = source.name, source.encoding
        self.width, self.height = source.width, source.height
        self._source, self._nonce = source, nonce

    def read(self) -> Frame:
        frame = self._source.read()
        if frame.encoding in {"jpeg", "png"}:
            return frame
        if not frame.data.flags.writeable:
            frame = replace(frame, data=frame.data.copy())
        digest = blake2b(f"{self._nonce}/{frame.index}".encode(), digest_size=SIDE * SIDE // 8).digest()
        bits = np.unpackbits(np.frombuffer(digest, np.uint8)).reshape(SIDE, SIDE)
        corner = frame.data[: 2 * SIDE, : 2 * SIDE]
        height, width = corner.shape[:2]  # a frame may be smaller than the stamp
        luma = np.where(bits, np.uint8(WHITE), np.uint8(BLACK)).repeat(2, 0).repeat(2, 1)[:height, :width]
        if frame.encoding == "yuv422_yuy2":
            corner[..., 0], corner[..., 1] = luma, GREY
        else:
            corner[...] = luma if corner.ndim == luma.ndim else luma[..., np.newaxis]
        return frame

    def close(self) -> None:
        self._source.close()
