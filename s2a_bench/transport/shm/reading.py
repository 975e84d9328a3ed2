"""A request as it lies in a client's memory, read without trust."""

from __future__ import annotations

from typing import Any, Final

import orjson

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Trace
from s2a_bench.transport.chunks import request_of, state_of
from s2a_bench.transport.limits import Limits, check_pixels, check_values, text, whole_number
from s2a_bench.transport.pictures import decoded, rgb_of
from s2a_bench.transport.shm.memory import SharedMemory
from s2a_bench.types import Frame, Request

HEADER_BYTES: Final = 1 << 20
"""The longest header: JSON takes up to 45 times its size while it is read, and leaves holes
that Python does not give back."""
BYTES_A_PIXEL: Final = {"bgr8": 3, "yuv422_yuy2": 2}


def size_of(memory: SharedMemory, at: int, length: int) -> int:
    """Return the bytes of a request whose header lies there; raises RequestFailed where it cannot."""
    if not (0 < length <= HEADER_BYTES and 0 <= at <= memory.size - length):
        raise RequestFailed(f"a header of {length} bytes at {at} cannot be; at most {HEADER_BYTES} are taken")
    return at + length


def request_at(memory: SharedMemory, at: int, length: int, limits: Limits, trace: Trace) -> Request:
    """Copy and parse a header, and read its pictures as the engine takes them; raises RequestFailed."""
    header = memory.map[at : at + length]
    check_values(header)
    try:
        fields = orjson.loads(header)
    except ValueError as error:
        raise RequestFailed(f"the header is no JSON: {error}") from error
    if not isinstance(fields, dict) or not isinstance(pictures := fields.get("images", []), list):
        raise RequestFailed("the header should be an object whose images are a list")
    trace.mark("header_parse")
    images, begin, pixels = [], 0, limits
    for about in pictures:
        size = about.get("bytes") if isinstance(about, dict) else None
        if type(size) is not int or size <= 0 or begin + size > at:
            raise RequestFailed("a picture should lie before the header")
        images.append(_picture(memory, about, begin, trace, pixels))
        if len(pictures) > 1:  # what the first ones leave to the others
            pixels = pixels.but(pixels=max(1, pixels.pixels - images[-1].width * images[-1].height))
        begin += size
    name, prompt = (text(key, fields.get(key)) for key in ("id", "prompt"))
    return request_of(fields, limits, name, prompt, tuple(images), state_of(fields.get("state") or ()))


def _picture(memory: SharedMemory, about: dict[str, Any], begin: int, trace: Trace, limits: Limits) -> Frame:
    """Convert a picture; raw pixels are read where they lie, a file that has a size of its own is copied first."""
    encoding = text("encoding", about.get("encoding"))
    end = begin + about["bytes"]
    if encoding not in BYTES_A_PIXEL:
        return decoded(encoding, memory.map[begin:end], trace, limits)
    width, height = (whole_number(side, about.get(side), 1, limits.pixels, 0) for side in ("width", "height"))
    check_pixels(width, height, limits)
    channels = BYTES_A_PIXEL[encoding]
    if end - begin != width * height * channels:
        raise RequestFailed(f"{end - begin} bytes are no {encoding} picture of {width}x{height}")
    pixels = memory.pixels[begin:end].reshape(height, width, channels)
    return rgb_of(Frame(-1, 0, width, height, encoding, pixels), trace)  # type: ignore[arg-type]
