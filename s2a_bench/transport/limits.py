"""Limits of our servers and bounds of an answer that a client reads, for all transports.

What exceeds them is refused before it costs memory or time. Every server gets `Limits` in its `Wiring`, and a run's
manifest records them; three are flags of `serve`. `Bounds` are those of one answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.frames import MOST_PIXELS
from s2a_bench.options import Options, option
from s2a_bench.types import Frame, Request

KIB: Final = 1 << 10
MIB: Final = 1 << 20
SEEDS: Final = (1 << 32) - 1


class Limits(Options):
    """Limits of one request and of all together. Users set those in `SET`; the others are the same for every server."""

    PANEL: ClassVar[str] = "Limits"

    body_mib: float = option(64.0, "largest body of a request, MiB", flag="max-body-mib", gt=0, le=MIB)
    header_kib: float = option(64.0, "longest headers of a request, KiB", gt=0, le=MIB)
    in_flight_mib: float = option(256.0, "bodies of all requests that are not answered yet, MiB", gt=0, le=MIB)
    connections: int = option(256, "most connections at once", ge=1, le=MIB)
    head_s: float = option(10.0, "seconds for a request's headers, or of silence within them", gt=0, le=86_400)
    body_s: float = option(120.0, "seconds for its body, or of silence within it", gt=0, le=86_400)
    pixels: int = option(MOST_PIXELS, "most pixels of a request's pictures", ge=1, le=2**31)
    waiting: int = option(64, "most requests that wait for the engine", flag="max-waiting", ge=0, le=MIB)
    answer_tokens: int = option(65_536, "most tokens that a request may ask for", ge=1, le=2**31 - 1)
    answer_s: float = option(
        600.0, "seconds from a request's arrival to its last token", flag="answer-timeout", gt=0, le=86_400
    )

    @property
    def body_bytes(self) -> int:
        return round(self.body_mib * MIB)

    @property
    def header_bytes(self) -> int:
        return round(self.header_kib * KIB)

    @property
    def in_flight_bytes(self) -> int:
        return round(self.in_flight_mib * MIB)


LIMITS: Final = Limits()
SET: Final = ("body_mib", "waiting", "answer_s")
"""The limits that `serve` has flags, keys and parameters for."""


def whole_number(name: str, value: Any, least: int, most: int, default: int) -> int:
    """Return a number from outside, or the default for None; raises RequestFailed for anything else."""
    if value is None:
        return default
    if type(value) is not int or not least <= value <= most:
        raise RequestFailed(f"{name} should be a whole number of {least} to {most}")
    return value


def text(name: str, value: Any, default: str = "") -> str:
    """Return a text from outside, or the default for None; raises RequestFailed for what UTF-8 cannot carry."""
    if value is None:
        return default
    if not isinstance(value, str):
        raise RequestFailed(f"{name} should be text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise RequestFailed(f"{name} is not Unicode text: it has half a surrogate pair") from None
    return value


def check_pixels(width: int, height: int, most: int) -> None:
    """Raise RequestFailed for a picture without pixels, or of too many."""
    if width <= 0 or height <= 0:
        raise RequestFailed(f"a picture of {width}x{height} is empty")
    if width * height > most:
        raise RequestFailed(f"a picture of {width}x{height}; at most {most} pixels are taken")


BYTES_A_TOKEN, BYTES = 16 << 10, 5 << 20
"""The most bytes of an answer, for each token and beside; a token in OpenAI's dialect takes 300 bytes."""


class Bounds:
    """Counts one answer of ``server``, whose name errors have, against its bounds."""

    def __init__(self, server: str, deadline_s: float, max_tokens: int) -> None:
        self._server = server
        self._deadline_s = deadline_s
        self._ends_ns = now_ns() + int(deadline_s * 1e9)
        self._max_tokens = max_tokens
        self._most_bytes = self._bytes = BYTES + BYTES_A_TOKEN * max_tokens

    def left_s(self) -> float:
        """Return the time left; raises RequestFailed after the deadline."""
        left_ns = self._ends_ns - now_ns()
        if left_ns <= 0:
            raise RequestFailed(
                f"{self._server} did not end its answer within {self._deadline_s:g} s; see `deadline` and `max_tokens`"
            )
        return left_ns / 1e9

    def count_bytes(self, size: int) -> None:
        """Count bytes; raises RequestFailed for more than an answer can need."""
        self._bytes -= size
        if self._bytes < 0:
            raise RequestFailed(
                f"{self._server} sent more than {self._most_bytes} bytes for {self._max_tokens} tokens (`max_tokens`)"
            )


def read_request(
    fields: Mapping[Any, Any],
    limits: Limits,
    name: str,
    prompt: str,
    images: tuple[Frame, ...],
    state: tuple[float, ...],
    max_tokens: int = 32,
) -> Request:
    """Return the request of a document; raises RequestFailed."""
    return Request(
        id=name,
        prompt=prompt,
        images=images,
        max_tokens=whole_number("max_tokens", fields.get("max_tokens"), 1, limits.answer_tokens, max_tokens),
        grammar=text("grammar", fields.get("grammar")),
        seed=whole_number("seed", fields.get("seed"), 0, SEEDS, 0),
        state=state,
    )
