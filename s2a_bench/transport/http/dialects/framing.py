"""Framings, which cut a body into messages, however its bytes arrive: events, lines of JSON, or the whole body."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol


class Framing(Protocol):
    def feed(self, data: bytes) -> Iterator[str | bytes]:
        """Yield the messages that these bytes complete; raises ValueError for malformed bytes."""

    def end(self) -> Iterator[str | bytes]:
        """Yield the last message after the end of the body."""


class Lines:
    """Lines that end with CR LF, LF or CR (WHATWG HTML, 9.2.6); bytes that are not UTF-8 become U+FFFD."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._after_cr = False

    def feed(self, data: bytes) -> Iterator[str]:
        if self._after_cr and data:
            data = data.removeprefix(b"\n")
            self._after_cr = False
        if b"\r" in data:
            self._after_cr = data.endswith(b"\r")
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        *complete, rest = data.split(b"\n")
        for block in complete:
            self._pieces.append(block)
            yield from self.end()
        self._pieces.append(rest)

    def end(self) -> Iterator[str]:
        line = b"".join(self._pieces)
        self._pieces = []
        yield line.decode("utf-8", "replace")


class JsonLines(Lines):
    """One JSON text on each line (NDJSON)."""

    def end(self) -> Iterator[str]:
        yield from filter(str.strip, super().end())


class WholeBody(Lines):
    def feed(self, data: bytes) -> Iterator[str]:
        self._pieces.append(data)
        yield from ()


class ServerSentEvents:
    """The data of server-sent events (WHATWG HTML, 9.2.6), comments and other fields left out.

    Unlike the standard it accepts a last event without its empty line, and bare JSON between events, which Gemini and
    some gateways send as errors, until an empty line or one of data.
    """

    def __init__(self) -> None:
        self._lines = Lines()
        self._data: list[str] = []
        self._bare = False
        self._first = True

    def feed(self, data: bytes) -> Iterator[str]:
        for line in self._lines.feed(data):
            yield from self._line(line)

    def end(self) -> Iterator[str]:
        for line in (*self._lines.end(), ""):
            yield from self._line(line)

    def _line(self, line: str) -> Iterator[str]:
        if self._first:
            line = line.removeprefix("\ufeff")
            self._first = False
        name, _, value = line.partition(":")
        is_data = name == "data"
        bare = bool(line) and not is_data and (self._bare or line.startswith(("{", "[")))
        if not line or ((is_data or bare) and bare != self._bare):
            yield from self._event()
        if is_data or bare:
            self._bare = bare
            self._data.append(line if bare else value.removeprefix(" "))

    def _event(self) -> Iterator[str]:
        data = "\n".join(self._data)
        self._data, self._bare = [], False
        if data:
            yield data
