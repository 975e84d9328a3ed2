"""Pictures, for every transport: encoding in the client, decoding to RGB in the server."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.frames.convert import decode_received, encode_jpeg, encode_png, to_bgr, to_rgb
from s2a_bench.trace import Trace
from s2a_bench.transport.limits import LIMITS, check_pixels
from s2a_bench.types import Frame, Pixels

JPEG_QUALITY = 90
RAW_MIME = "application/x-raw"
RAW_BYTES = {"bgr8": 3, "yuv422_yuy2": 2}
"""Encoding -> bytes of a pixel, of what has `RAW_MIME`."""
STAGES = {
    **dict.fromkeys(("bgr8", "bgra8", "rgba8"), "channel_swap"),
    **dict.fromkeys(("yuv422_yuy2", "yuv422", "nv12", "nv21"), "yuv_decode"),
}
"""Encoding -> the stage of its conversion to RGB; of all others `image_decode`."""


def bgr_of(frame: Frame, trace: Trace, out: Pixels | None = None) -> Frame:
    """Convert a camera's frame to ``bgr8``, into ``out`` if given; marks `convert` unless nothing is to be done."""
    if frame.encoding == "bgr8" and out is None:
        return frame
    converted = replace(frame, encoding="bgr8", data=to_bgr(frame, out))
    trace.mark("convert")
    return converted


def rgb_of(frame: Frame, trace: Trace) -> Frame:
    """Convert any frame to ``rgb8`` for the engine; marks `channel_swap`, `yuv_decode` or `image_decode`.

    Raises RequestFailed for pixels that do not fit their encoding.
    """
    if frame.encoding == "rgb8":
        return frame
    try:
        converted = replace(frame, encoding="rgb8", data=to_rgb(frame))
    except ValueError as error:
        raise RequestFailed(f"a {frame.width}x{frame.height} {frame.encoding} picture cannot be: {error}") from error
    trace.mark(STAGES.get(frame.encoding, "image_decode"))
    return converted


def encoded(frame: Frame, payload: str, trace: Trace) -> tuple[str, Pixels]:
    """Return the media type and the bytes of a picture as ``payload``; marks `convert` and `image_encode`."""
    if frame.encoding in {"jpeg", "png"}:
        return f"image/{frame.encoding}", frame.data
    bgr = bgr_of(frame, trace)
    if payload == "raw":
        return raw_mime(bgr, "bgr8"), bgr.data.reshape(-1)
    if payload == "jpeg":
        data = encode_jpeg(bgr.data, JPEG_QUALITY)
    elif payload == "png":
        data = encode_png(bgr.data)
    else:
        raise UsageError(f"payload '{payload}' needs a frame that is encoded already")
    trace.mark("image_encode")
    return f"image/{payload}", data


def raw_mime(frame: Frame, encoding: str) -> str:
    """Return the media type of a frame's pixels."""
    return f"{RAW_MIME};encoding={encoding};width={frame.width};height={frame.height}"


def decoded(media_type: str, data: bytes | memoryview, trace: Trace, most_pixels: int = LIMITS.pixels) -> Frame:
    """Convert received bytes to an ``rgb8`` frame, with the marks of `rgb_of`. Raises RequestFailed.

    ``most_pixels`` are what a request's earlier pictures leave of its limit.
    """
    try:
        if media_type.startswith(RAW_MIME):
            parameters = dict(each.split("=", 1) for each in media_type.split(";")[1:])
            width, height = int(parameters["width"]), int(parameters["height"])
            check_pixels(width, height, most_pixels)
            encoding: Any = parameters["encoding"]
            if encoding not in RAW_BYTES:
                raise ValueError(f"raw encoding '{encoding}' is not one of {', '.join(RAW_BYTES)}")
            pixels = np.frombuffer(data, np.uint8).reshape(height, width, RAW_BYTES[encoding])
            return rgb_of(Frame(-1, 0, width, height, encoding, pixels), trace)
        rgb = decode_received(data)  # OpenCV's own limit of pixels bounds what this allocates
    except (ValueError, KeyError) as error:
        raise RequestFailed(f"the {len(data)} bytes sent as {media_type} are not such a picture: {error}") from error
    check_pixels(rgb.shape[1], rgb.shape[0], most_pixels)
    trace.mark("image_decode")
    return Frame(-1, 0, rgb.shape[1], rgb.shape[0], "rgb8", rgb)
