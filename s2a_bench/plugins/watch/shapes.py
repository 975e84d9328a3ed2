"""Describes a decoded request in words: its pictures, numbers and texts."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.frames.convert import decode_received, encode_jpeg
from s2a_bench.transport.pictures import JPEG_QUALITY

LEAST_SIDE: Final = 16
"""Pixels of an array that counts as a picture."""
LEAST_LETTERS: Final = 256
"""The least letters of a text that may be a picture in Base64."""
MOST: Final = 10_000
"""Values of a request that are looked at."""
FILES: Final = {b"\xff\xd8\xff": "JPEG", b"\x89PNG": "PNG"}
NUMBER, TEXT, BYTE = "number", "text", "byte"


def described(request: Any) -> str:
    """Describe a request: "3 pictures 224x224 float32, 8 numbers, 1 text; as JPEG about 60 kB"."""
    counts, jpeg = Counter[str](), 0
    for kind, count, size in islice(_values(request), MOST):
        counts[kind] += count
        jpeg += size
    words = ", ".join(f"{count} {_plural(kind) if count > 1 else kind}" for kind, count in counts.items())
    return words + (f"; as JPEG about {max(1, round(jpeg / 1e3))} kB" if jpeg else "")


def _plural(kind: str) -> str:
    noun, *rest = kind.split(" ", 1)
    return " ".join((f"{noun}s", *rest))


def _values(value: Any) -> Iterator[tuple[str, int, int]]:
    """Yield kind, count, and the bytes as JPEG of pictures in other codings."""
    if isinstance(value, dict):
        for each in value.values():
            yield from _values(each)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _values(each)
    elif isinstance(value, np.ndarray):
        yield _array(value)
    elif isinstance(value, str):
        yield _file(_unwrapped(value)) or (TEXT, 1, 0)
    elif isinstance(value, bytes):
        yield _file(value) or (BYTE, len(value), 0)
    elif isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        yield NUMBER, 1, 0


def _array(array: NDArray[Any]) -> tuple[str, int, int]:
    """Distinguish pictures, (..., H, W, 3) or (..., 3, H, W), from numbers."""
    if array.ndim >= 3 and array.shape[-3] == 3 != array.shape[-1]:  # noqa: PLR2004 - colours first
        array = np.moveaxis(array, -3, -1)
    if array.ndim < 3 or array.shape[-1] != 3 or min(array.shape[-3:-1]) < LEAST_SIDE:  # noqa: PLR2004
        return NUMBER, array.size, 0
    height, width = array.shape[-3:-1]
    count, size = prod(array.shape[:-3]), 0
    for picture in islice(array.reshape(-1, height, width, 3), MOST):
        with suppress(ValueError):
            size += len(encode_jpeg(_bytes_of(picture), JPEG_QUALITY))
    return f"picture {width}x{height} {array.dtype}", count, size


def _bytes_of(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the values 0 to 255 of a picture, whose floats are 0 to 1 or -1 to 1."""
    if picture.dtype.kind == "f" and np.abs(picture).max() <= 1:
        picture = (picture + 1) / 2 * 255 if picture.min() < 0 else picture * 255
    return np.ascontiguousarray(np.nan_to_num(picture).clip(0, 255).astype(np.uint8))


def _unwrapped(text: str) -> bytes:
    """Return the bytes of a data URI, or of a long text in Base64; nothing of any other text."""
    data = text.partition(";base64,")[2] if text.startswith("data:") else text if len(text) > LEAST_LETTERS else ""
    with suppress(ValueError):
        return base64.b64decode(data, validate=True)
    return b""


def _file(data: bytes) -> tuple[str, int, int] | None:
    kind = next((name for magic, name in FILES.items() if data.startswith(magic)), "")
    if not kind:
        return None
    with suppress(ValueError):
        rgb = decode_received(data)
        size = 0 if kind == "JPEG" else len(encode_jpeg(np.ascontiguousarray(rgb), JPEG_QUALITY))
        return f"{kind} {rgb.shape[1]}x{rgb.shape[0]}", 1, size
    return None
