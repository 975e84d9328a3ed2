"""Exact colour conversion and image coding on uint8 arrays, by OpenCV.

YUYV is ITU-R BT.601 with limited range (Y 16..235), as V4L2 cameras deliver it. OpenCV computes it in 20-bit
fixed point, within 1 of the real-valued formula. Pixel arrays may be read-only or windows of larger ones as long as
the pixels of a row are contiguous; ``out`` must not overlap ``data``.
"""

from __future__ import annotations

from typing import Final, TypeAlias, cast, get_args

import cv2
import numpy as np

from s2a_bench.types import Deep, Frame, Pixels

BytesLike: TypeAlias = "bytes | bytearray | memoryview | Pixels"

# Newer OpenCV has the decoder write RGB itself: the same pixels without another pass over the picture; 4.9 cannot.
_DECODE_RGB: int | None = getattr(cv2, "IMREAD_COLOR_RGB", None)

_SIGNATURES: Final = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")
AS_IT_IS: Final = -1
"""Instead of a code of OpenCV: no conversion."""


def yuyv_to_rgb(data: Pixels, out: Pixels | None = None) -> Pixels:
    """Convert (h, w, 2) ``yuv422_yuy2`` to (h, w, 3) ``rgb8``, into ``out`` if given; ValueError on a wrong shape."""
    return _convert(data, 2, cv2.COLOR_YUV2RGB_YUY2, out)


def bgr_to_rgb(data: Pixels, out: Pixels | None = None) -> Pixels:
    """Swap the outer channels of (h, w, 3), either way, into ``out`` if given; ValueError on a wrong shape."""
    return _convert(data, 3, cv2.COLOR_BGR2RGB, out)


_CODES: Final[dict[str, tuple[int, int, int]]] = {
    "bgr8": (3, AS_IT_IS, cv2.COLOR_BGR2RGB),
    "rgb8": (3, cv2.COLOR_RGB2BGR, AS_IT_IS),
    "bgra8": (4, cv2.COLOR_BGRA2BGR, cv2.COLOR_BGRA2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2BGR, cv2.COLOR_RGBA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2BGR, cv2.COLOR_GRAY2RGB),
    "mono16": (1, cv2.COLOR_GRAY2BGR, cv2.COLOR_GRAY2RGB),
    "rgb16": (3, cv2.COLOR_RGB2BGR, AS_IT_IS),
    "bgr16": (3, AS_IT_IS, cv2.COLOR_BGR2RGB),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY, cv2.COLOR_YUV2RGB_UYVY),
    "nv12": (1, cv2.COLOR_YUV2BGR_NV12, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2BGR_NV21, cv2.COLOR_YUV2RGB_NV21),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR, cv2.COLOR_BayerGRBG2RGB),
}
"""Raw encoding -> channels of OpenCV's input, its code to BGR, its code to RGB."""


def to_bgr(frame: Frame, out: Pixels | None = None) -> Pixels:
    """Return the frame's picture as (h, w, 3) ``bgr8``: its own data where it is that already, else a new array.

    With ``out`` it is there. Raises ValueError when the data does not fit the frame's encoding.
    """
    if frame.encoding not in _CODES:
        bgr = _decode(frame.data, cv2.IMREAD_COLOR)
    else:
        channels, code, _ = _CODES[frame.encoding]
        data = _eight_bits(frame)
        fits = code != AS_IT_IS and out is not None and out.shape[:2] == data.shape[:2]  # NV12 has more rows
        bgr = _convert(data, channels, code, out if fits else None)
    if out is not None and bgr is not out:
        out[...] = bgr
        return out
    return bgr


def to_rgb(frame: Frame) -> Pixels:
    """Return the frame's picture as (h, w, 3) ``rgb8``, otherwise as `to_bgr` does."""
    if frame.encoding in _CODES:
        channels, _, code = _CODES[frame.encoding]
        return _convert(_eight_bits(frame), channels, code)
    return decode_image(frame.data)


def _eight_bits(frame: Frame) -> Pixels:
    """Return the frame's data, 16 bits scaled as cv_bridge does: 65535 is 255."""
    if frame.encoding not in get_args(Deep):
        return frame.data
    values = np.ascontiguousarray(frame.data).view(np.uint16)
    values = values[..., 0] if frame.encoding == "mono16" else values
    return cast("Pixels", cv2.convertScaleAbs(values, alpha=255 / 65535))


def encode_jpeg(bgr: Pixels, quality: int = 90) -> Pixels:
    """Compress (h, w, 3) ``bgr8`` to JPEG with 4:2:0 chroma, as (n,) uint8; ``quality`` is libjpeg's, 1 to 100."""
    return _encode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_png(bgr: Pixels) -> Pixels:
    """Compress (h, w, 3) ``bgr8`` to PNG without loss, as (n,) uint8."""
    return _encode(".png", bgr, [])


def decode_image(data: BytesLike) -> Pixels:
    """Decode a JPEG, PNG or other picture file to (h, w, 3) ``rgb8``; ValueError for another file, or a too large one.

    A truncated JPEG is an error in OpenCV 5; OpenCV 4 fills in the missing part.
    """
    if _DECODE_RGB is not None:
        return _decode(data, _DECODE_RGB)
    return bgr_to_rgb(_decode(data, cv2.IMREAD_COLOR))


def decode_received(data: BytesLike) -> Pixels:
    """Decode a JPEG or PNG from outside as `decode_image` does; ValueError for any other format."""
    if not bytes(data[:8]).startswith(_SIGNATURES):
        raise ValueError("neither a JPEG nor a PNG")
    return decode_image(data)


def resize(bgr: Pixels, width: int, height: int) -> Pixels:
    """Scale (h, w, 3) to (height, width, 3), unless it has that size; the aspect ratio is not kept."""
    if bgr.shape[:2] == (height, width):
        return bgr
    return cast("Pixels", cv2.resize(bgr, (width, height), interpolation=cv2.INTER_AREA))


def _convert(data: Pixels, channels: int, code: int, out: Pixels | None = None) -> Pixels:
    """Run one cvtColor with checks: OpenCV would silently leave an unfit ``out`` unchanged."""
    last = data.shape[2:]
    if data.ndim < 2 or last != ((channels,) if channels > 1 else ()) or data.dtype != np.uint8:  # noqa: PLR2004
        wanted = f"(h, w, {channels})" if channels > 1 else "(h, w)"
        raise ValueError(f"pixels should be uint8 of shape {wanted}, not {data.dtype} {data.shape}")
    if channels == 2 and data.shape[1] % 2:  # noqa: PLR2004
        raise ValueError(f"YUYV holds pixels in pairs: the width cannot be {data.shape[1]}")
    if out is not None and (out.shape != (*data.shape[:2], 3) or out.dtype != np.uint8):
        raise ValueError(f"out should be uint8 of shape {(*data.shape[:2], 3)}, not {out.dtype} {out.shape}")
    if code == AS_IT_IS:
        return data
    try:
        return cast("Pixels", cv2.cvtColor(data, code, dst=out))
    except cv2.error as error:
        raise ValueError(f"OpenCV cannot convert pixels of shape {data.shape}: {error}") from error


def _encode(suffix: str, bgr: Pixels, parameters: list[int]) -> Pixels:
    done, data = cv2.imencode(suffix, bgr, parameters)
    if not done:
        raise ValueError(f"OpenCV cannot write {bgr.dtype} {bgr.shape} as {suffix}")
    return data


def _decode(data: BytesLike, flags: int) -> Pixels:
    buffer = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    try:
        picture = cv2.imdecode(buffer, flags) if buffer.size else None
    except cv2.error as error:
        raise ValueError(f"the {buffer.size} bytes are not a picture that OpenCV can read: {error.err}") from error
    if picture is None:
        raise ValueError(f"the {buffer.size} bytes are not a picture that OpenCV can read")
    return cast("Pixels", picture)
