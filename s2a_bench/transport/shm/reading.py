"""A request as it lies in a client's memory, read without trust."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock
from typing import Any, Final

import orjson

from s2a_bench.errors import Busy, RequestFailed
from s2a_bench.trace import Trace
from s2a_bench.transport.chunks import state_of
from s2a_bench.transport.limits import SEEDS, Limits, check_pixels, text, whole_number
from s2a_bench.transport.pictures import decoded, rgb_of
from s2a_bench.transport.shm.memory import PICTURES_AT, Memory
from s2a_bench.types import Frame, Request

HEADER_BYTES: Final = 1 << 20
"""The longest header: JSON takes up to 45 times its size while it is read, and leaves holes
that Python does not give back."""
BYTES_A_PIXEL: Final = {"bgr8": 3, "yuv422_yuy2": 2}


class Held:
    """What all requests that are not answered yet hold."""

    def __init__(self, limits: Limits) -> None:
        """Hold nothing."""
        self._limits, self._lock, self._bytes = limits, Lock(), 0

    def take(self, memory: Memory, at: int, length: int) -> int:
        """Count a request whose header lies there; raises RequestFailed where it cannot, Busy where it is too much."""
        if not (0 < length <= HEADER_BYTES and at >= PICTURES_AT and at + length <= memory.size):
            raise RequestFailed(f"a header of {length} bytes at {at} cannot be; at most {HEADER_BYTES} are taken")
        size = at + length - PICTURES_AT
        with self._lock:
            if self._bytes + size > self._limits.in_flight_bytes:
                raise Busy(f"requests of {self._limits.in_flight_bytes} bytes are under way already")
            self._bytes += size
        return size

    def give_back(self, size: int) -> None:
        """Count it no more."""
        with self._lock:
            self._bytes -= size


@dataclass(frozen=True, slots=True)
class Header:
    """What a request says, and where its pictures lie."""

    fields: dict[str, Any]
    pictures: list[tuple[dict[str, Any], int]]
    limits: Limits

    @staticmethod
    def read(memory: Memory, at: int, length: int, limits: Limits) -> Header:
        """Copy and parse it; raises RequestFailed."""
        try:
            fields = orjson.loads(memory.map[at : at + length])
        except ValueError as error:
            raise RequestFailed(f"the header is no JSON: {error}") from error
        if not isinstance(fields, dict) or not isinstance(told := fields.get("images", []), list):
            raise RequestFailed("the header should be an object whose images are a list")
        pictures, begin = [], PICTURES_AT
        for about in told:
            size = about.get("bytes") if isinstance(about, dict) else None
            if type(size) is not int or size <= 0 or begin + size > at:
                raise RequestFailed("a picture should lie before the header")
            pictures.append((about, begin))
            begin += size
        return Header(fields, pictures, limits)

    def request(self, memory: Memory, trace: Trace) -> Request:
        """Return it with pictures as the engine takes them; raises RequestFailed."""
        fields, limits, images = self.fields, self.limits, []
        for about, begin in self.pictures:
            images.append(_picture(memory, about, begin, trace, limits))
            if len(self.pictures) > 1:  # what the first ones leave to the others
                left = limits.pixels - images[-1].width * images[-1].height
                limits = limits.but(pixels=max(1, left))
        return Request(
            id=text("id", fields.get("id")),
            prompt=text("prompt", fields.get("prompt")),
            images=tuple(images),
            max_tokens=whole_number("max_tokens", fields.get("max_tokens"), 1, self.limits.answer_tokens, 32),
            grammar=text("grammar", fields.get("grammar")),
            seed=whole_number("seed", fields.get("seed"), 0, SEEDS, 0),
            state=state_of(fields.get("state") or ()),
        )


def _picture(memory: Memory, about: dict[str, Any], begin: int, trace: Trace, limits: Limits) -> Frame:
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
