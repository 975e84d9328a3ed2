"""What a server of ours takes, and a client of one answer, in one place for all transports.

More is refused before it costs memory or time. `Limits` are handed to every server in its `Wiring` and recorded in the
manifest of a run; three are flags of `serve`. `Bounds` are those of one answer.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar, Final

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.options import Options, option

KIB: Final = 1 << 10
MIB: Final = 1 << 20
SEEDS: Final = (1 << 32) - 1
VALUES: Final = 20_000
"""The most values of a document, JSON or MessagePack, that comes from outside."""


STEP: Final = 1 << 16
"""Bytes of a document that are looked at together."""


class Limits(Options):
    """The most that is taken of one request, and of all at once, over every transport as far as it has such a thing.

    Users set those that `SET` names; the others are the same for every server.
    """

    PANEL: ClassVar[str] = "Limits"

    body_mib: float = option(64.0, "largest body of a request, MiB", flag="max-body-mib", gt=0, le=MIB)
    header_kib: float = option(64.0, "longest headers of a request, KiB", gt=0, le=MIB)
    in_flight_mib: float = option(256.0, "bodies of all requests that are not answered yet, MiB", gt=0, le=MIB)
    connections: int = option(256, "most connections at once", ge=1, le=MIB)
    head_s: float = option(10.0, "seconds from a request's first byte to the end of its headers", gt=0, le=86_400)
    body_s: float = option(120.0, "seconds from there to the end of its body", gt=0, le=86_400)
    pixels: int = option(50_000_000, "most pixels of a picture, read before it is decoded", ge=1, le=2**31)
    waiting: int = option(64, "most requests that wait for the engine", flag="max-waiting", ge=0, le=MIB)
    answer_tokens: int = option(65_536, "most tokens that a request may ask for", ge=1, le=2**31 - 1)
    answer_s: float = option(
        600.0, "seconds from a request's arrival to its last token", flag="answer-timeout", gt=0, le=86_400
    )

    @property
    def body_bytes(self) -> int:
        """Return the largest body in bytes."""
        return round(self.body_mib * MIB)

    @property
    def header_bytes(self) -> int:
        """Return the longest headers in bytes."""
        return round(self.header_kib * KIB)

    @property
    def in_flight_bytes(self) -> int:
        """Return in bytes what the bodies of all requests may be together."""
        return round(self.in_flight_mib * MIB)


LIMITS: Final = Limits()
SET: Final = ("body_mib", "waiting", "answer_s")
"""What `serve` has flags, keys and parameters for."""


def whole_number(name: str, value: Any, least: int, most: int, default: int) -> int:
    """Return a number that came from outside, or the default for None; raises RequestFailed for anything else."""
    if value is None:
        return default
    if type(value) is not int or not least <= value <= most:
        raise RequestFailed(f"{name} should be a whole number of {least} to {most}")
    return value


def text(name: str, value: Any, default: str = "") -> str:
    """Return a text that came from outside, or the default for None; raises RequestFailed for what cannot be sent."""
    if value is None:
        return default
    if not isinstance(value, str):
        raise RequestFailed(f"{name} should be text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise RequestFailed(f"{name} is no Unicode text: it has half a surrogate pair") from None
    return value


def check_values(document: bytes | bytearray) -> None:
    """Raise RequestFailed for a JSON document of too many values, before it is parsed; other bytes may pass.

    Values are at most as many as commas and openings; those within strings are left out only where it matters.
    """
    if _openings(document) <= VALUES:
        return
    values, quotes, within, rest = 0, 0, 0, b""
    for at in range(0, len(document), STEP):
        plain = (rest + document[at : at + STEP]).replace(rb"\\", b"")
        rest = b"\\" if plain.endswith(b"\\") else b""  # what it escapes comes with the next step
        parts = plain.replace(rb"\"", b"").split(b'"')
        values += _openings(b"".join(parts[within::2]))
        quotes += len(parts) - 1
        within = quotes % 2
        if values > VALUES or quotes > 4 * VALUES:
            raise RequestFailed(f"the document has more than {VALUES} values")


def _openings(document: bytes | bytearray) -> int:
    """Count what opens a value or follows one, up to one too many; `find` is 20 times as fast as `count`."""
    count = 0
    for sign in (b",", b"[", b"{"):
        at = document.find(sign)
        while at >= 0 and count <= VALUES:
            count += 1
            at = document.find(sign, at + 1)
    return count


def check_pixels(width: int, height: int, limits: Limits) -> None:
    """Raise RequestFailed for a picture of more pixels than are taken, or of none."""
    if width <= 0 or height <= 0:
        raise RequestFailed(f"a picture of {width}x{height} is empty")
    if width * height > limits.pixels:
        raise RequestFailed(f"a picture of {width}x{height}; at most {limits.pixels} pixels are taken")


def check_encoded(data: memoryview, limits: Limits) -> None:
    """Raise RequestFailed for a file that is no JPEG or PNG, or of too many pixels, as its header says."""
    size = _png_size(data) or _jpeg_size(data)
    if size is None:
        raise RequestFailed(f"{len(data)} bytes that are neither a JPEG nor a PNG")
    check_pixels(*size, limits)


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
"""Those that no length follows."""


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    """Read the first frame header (ITU T.81, B.2.2), skipping what libjpeg skips before a marker."""
    if bytes(data[:2]) != b"\xff\xd8":
        return None
    at = 2
    for _ in range(_SEGMENTS):
        found = _MARKER.match(data, at)
        if found is None or found.end() + 7 > len(data):
            return None
        marker, at = found[1][0], found.end()
        if marker in _FRAME:
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 3 : at + 5], "big")
        if marker not in _ALONE:
            at += max(2, int.from_bytes(data[at : at + 2], "big"))
    return None


PIECES_A_TOKEN, PIECES = 8, 64
"""A server may count otherwise, or send letters: an answer may have so many pieces a token, and some more."""
BYTES_A_TOKEN, BYTES = 16 << 10, 5 << 20
"""All that comes, headers included, in the same way; a token in OpenAI's dialect takes 300 bytes."""


class Bounds:
    """The bounds of one answer, told of what comes."""

    def __init__(self, who: str, deadline_s: float, max_tokens: int) -> None:
        """Start the time; errors name ``who`` answers."""
        self._who = who
        self._deadline_s = deadline_s
        self._ends_ns = now_ns() + int(deadline_s * 1e9)
        self._max_tokens = max_tokens
        self._most_pieces = self._pieces = PIECES + PIECES_A_TOKEN * max_tokens
        self._most_bytes = self._bytes = BYTES + BYTES_A_TOKEN * max_tokens

    def left_s(self) -> float:
        """Return the time that is left; raises RequestFailed after the deadline."""
        left_ns = self._ends_ns - now_ns()
        if left_ns <= 0:
            raise RequestFailed(
                f"{self._who} did not end its answer within {self._deadline_s:g} s; see `deadline` and `max_tokens`"
            )
        return left_ns / 1e9

    def count_bytes(self, size: int) -> None:
        """Count bytes; raises RequestFailed for more than an answer can need."""
        self._bytes -= size
        if self._bytes < 0:
            raise RequestFailed(
                f"{self._who} sent more than {self._most_bytes} bytes for {self._max_tokens} tokens (`max_tokens`)"
            )

    def count_piece(self) -> None:
        """Count a piece of the answer; raises RequestFailed where the server does not stop."""
        self._pieces -= 1
        if self._pieces < 0:
            raise RequestFailed(
                f"{self._who} does not stop: {self._most_pieces} pieces came for {self._max_tokens} tokens "
                "(`max_tokens`)"
            )
