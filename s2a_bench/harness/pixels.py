"""Checksums of pictures: to notice one that comes twice, and one that changed on its way.

They are computed outside all marks, after an answer's last token.
"""

from __future__ import annotations

import zlib

from s2a_bench.frames.convert import bgr_to_rgb, decode_image, to_bgr, yuyv_to_rgb
from s2a_bench.types import Frame, Pixels

RGB_ENGINE = "rgb_engine"
"""The fact by which a server tells the checksum of its engine's pixels."""


def fingerprint(frame: Frame) -> int:
    """Return a checksum (CRC-32) of a picture as it lies in memory."""
    return _checksum(frame.data)


def rgb_fingerprint(frame: Frame) -> int:
    """Return the checksum of the RGB that a direct conversion of the frame gives."""
    match frame.encoding:
        case "rgb8":
            return _checksum(frame.data)
        case "yuv422_yuy2":
            return _checksum(yuyv_to_rgb(frame.data))
        case "jpeg" | "png":
            return _checksum(decode_image(frame.data))
        case _:
            return _checksum(bgr_to_rgb(to_bgr(frame)))


def _checksum(pixels: Pixels) -> int:
    return zlib.crc32(pixels.reshape(-1).data)
