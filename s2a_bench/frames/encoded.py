"""The size of a JPEG or PNG, from its header: known before it is decoded."""

from __future__ import annotations

import re
from typing import Final

MOST_PIXELS: Final = 50_000_000
"""A picture from outside that has more is not decoded."""


def encoded_size(data: memoryview) -> tuple[int, int] | None:
    """Return width and height of a JPEG or PNG; None for what is neither."""
    return _png_size(data) or _jpeg_size(data)


def _png_size(data: memoryview) -> tuple[int, int] | None:
    """Read IHDR, which comes first (PNG, third edition, 5.6)."""
    head = bytes(data[:24])
    if not (head.startswith(b"\x89PNG\r\n\x1a\n") and head[12:16] == b"IHDR"):
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:], "big")


_MARKER = re.compile(rb"[^\xff]*\xff+([^\xff])", re.DOTALL)
_SEGMENTS = 10_000
"""More than any picture has before its frame header."""
_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG's frame header (ITU T.81, table B.1)."""
_ALONE = frozenset({0x00, 0x01, *range(0xD0, 0xD8)})
"""Markers without a length."""


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    """Read the first frame header (ITU T.81, B.2.2), skipping what libjpeg skips before a marker."""
    if bytes(data[:2]) != b"\xff\xd8":
        return None
    at = 2
    for _ in range(_SEGMENTS):
        match = _MARKER.match(data, at)
        if match is None or match.end() + 7 > len(data):
            return None
        marker, at = match[1][0], match.end()
        if marker in _FRAME:
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 3 : at + 5], "big")
        if marker not in _ALONE:
            at += max(2, int.from_bytes(data[at : at + 2], "big"))
    return None
