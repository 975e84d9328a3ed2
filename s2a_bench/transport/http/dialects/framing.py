"""Cutting a body into messages, with the same result for any cut of the bytes: events, lines of JSON, or the whole."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

LIMIT = 4 << 20
"""Bytes of one message: far above any token, and a bound for a server that never ends its line."""


class Framing(Protocol):
    """How messages are cut out of a body."""

    def feed(self, data: bytes) -> Iterator[str | bytes]:
        """Yield the messages that these bytes complete; raises ValueError for one that is too large."""
        ...

    def end(self) -> Iterator[str | bytes]:
        """Yield what is left when the body has ended."""
        ...


class Lines:
    """Bytes in, lines out; a line ends with CR LF, LF or CR (WHATWG HTML, 9.2.6)."""

    def __init__(self) -> None:
        """Start at the beginning of a body."""
        self._pieces: list[bytes] = []
        self._size = 0
        self._after_cr = False

    def feed(self, data: bytes) -> Iterator[str]:
        """Yield the lines that these bytes complete; bytes that are no UTF-8 become U+FFFD."""
        if self._after_cr and data:
            data = data.removeprefix(b"\n")
            self._after_cr = False
        if b"\r" in data:
            self._after_cr = data.endswith(b"\r")
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        *ended, rest = data.split(b"\n")
        for part in ended:
            self._keep(part)
            yield from self.end()
        self._keep(rest)

    def _keep(self, part: bytes) -> None:
        self._pieces.append(part)
        self._size += len(part)
        if self._size > LIMIT:
            raise ValueError(f"a line of more than {LIMIT} bytes")

    def end(self) -> Iterator[str]:
        line = b"".join(self._pieces)
        self._pieces, self._size = [], 0
        yield line.decode("utf-8", "replace")


class JsonLines:
    """One JSON text a line (NDJSON)."""

    def __init__(self) -> None:
        """Start at the beginning of a body."""
        self._lines = Lines()

    def feed(self, data: bytes) -> Iterator[str]:
        yield from filter(str.strip, self._lines.feed(data))

    def end(self) -> Iterator[str]:
        yield from filter(str.strip, self._lines.end())


class ServerSentEvents:
    """The data of server-sent events (WHATWG HTML, 9.2.6), comments and other fields left out.

    Two liberties: a last event without its empty line counts, and JSON that stands bare between events, as Gemini and
    some gateways send their errors, is a message too, until an empty line or one of data.
    """

    def __init__(self) -> None:
        """Start at the beginning of a body."""
        self._lines = Lines()
        self._data: list[str] = []
        self._size = 0
        self._bare = False
        self._first = True

    def feed(self, data: bytes) -> Iterator[str]:
        for line in self._lines.feed(data):
            yield from self._line(line)

    def end(self) -> Iterator[str]:
        """Yield an event without its empty line."""
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
            self._hold(line if bare else value.removeprefix(" "))

    def _hold(self, text: str) -> None:
        self._data.append(text)
        self._size += len(text) + 1
        if self._size > LIMIT:
            raise ValueError(f"an event of more than {LIMIT} characters")

    def _event(self) -> Iterator[str]:
        """Yield what an empty line, or one of another kind, ends."""
        data = "\n".join(self._data)
        self._data, self._size, self._bare = [], 0, False
        if data:
            yield data


class WholeBody:
    """A body that is one message."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0

    def feed(self, data: bytes) -> Iterator[str]:
        self._pieces.append(data)
        self._size += len(data)
        if self._size > LIMIT:
            raise ValueError(f"a body of more than {LIMIT} bytes")
        yield from ()

    def end(self) -> Iterator[str]:
        yield b"".join(self._pieces).decode("utf-8", "replace")
