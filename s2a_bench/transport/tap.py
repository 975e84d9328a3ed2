"""Reads the exchanges of a client and an external server from copies of the bytes that a tap passes on.

A transport declares its reader (`Transport.reader`), a subclass of `TapReader`: it finds where requests and answers
begin and end. It does no I/O, keeps at most `MOST_BYTES` of one message, and may raise anything: the tap goes on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any, Final

MOST_BYTES: Final = 64 << 20
"""The most bytes of a message that is decoded."""
DECODED_BYTES: Final = 4 << 20
"""The most bytes of an answer in one piece that is decoded."""
MOST_WAITING: Final = 1000
"""Requests of a connection that wait for their answers."""
MOST_KINDS: Final = 32
OTHERS: Final = "others"
"""The kind of all requests after so many kinds."""
MOST_PIECES: Final = 1 << 20
"""The most pieces of an answer, which need not end."""
LETTERS: Final = 100
"""The most letters of an exchange's kind."""
FAILED: Final = "an error in place of an answer"
"""The text of every error: a server's own may contain a key or the robot's prompt."""


@dataclass(slots=True, eq=False)
class Seen:
    """One exchange as a tap saw it: times in ns of CLOCK_MONOTONIC, 0 for what did not happen.

    ``what`` is the kind of exchange, such as ``POST /v1/chat/completions``, without what may hold a key.
    """

    what: str
    request_ns: int
    """The first byte of the request arrived."""
    sent_ns: int = 0
    """The last byte of the request was passed on."""
    answer_ns: int = 0
    """The first byte of the answer arrived."""
    end_ns: int = 0
    """The last byte of the answer was passed on."""
    up_bytes: int = 0
    down_bytes: int = 0
    pieces_ns: list[int] = field(default_factory=list)
    """When each token or partial action had been passed on; empty for an answer in one piece."""
    infer_ms: float | None = None
    """The time of inference that the server reports."""
    chunk: tuple[int, int] | None = None
    """Actions of the answer, and numbers of each: (H, D)."""
    observation: Any = None
    """The decoded request, if it is the first of its kind: numbers, texts, bytes and arrays in lists and dicts."""
    error: str = ""


class TapReader:
    """Pairs the requests of one connection with its answers, in order; subclasses read `up` and `down`.

    A subclass calls `begin_request` at the first byte of a request and `end_request` at its last one, then
    `begin_answer` and `end_answer`. What a server sends while no request waits, such as a greeting, is not an answer.
    """

    def __init__(self, report: Callable[[Seen], None], kinds: set[str]) -> None:
        """Call ``report`` with each exchange; ``kinds`` are the kinds whose requests need not be decoded any more."""
        self.report = report
        self.pings = 0
        self.from_ns = self.to_ns = 0
        """When the bytes that are read arrived, and when they had been passed on."""
        self._kinds = kinds
        self._waiting = deque[Seen]()

    def passed(self, data: bytes, from_ns: int, to_ns: int, *, up: bool) -> None:
        """Read bytes that went up, to the server, or down."""
        self.from_ns, self.to_ns = from_ns, to_ns
        (self.up if up else self.down)(data)

    def up(self, data: bytes) -> None:
        raise NotImplementedError

    def down(self, data: bytes) -> None:
        raise NotImplementedError

    def fresh(self, seen: Seen) -> bool:
        """Whether a request is the first of its kind, whose content is wanted; beyond `MOST_KINDS` all are one kind."""
        if seen.what not in self._kinds and len(self._kinds) >= MOST_KINDS:
            seen.what = OTHERS
        fresh = seen.what not in self._kinds
        self._kinds.add(seen.what)
        return fresh

    def begin_request(self, what: str = "") -> Seen:
        seen = Seen(what, self.from_ns)
        self._waiting.append(seen)
        if len(self._waiting) > MOST_WAITING:
            raise ValueError(f"more than {MOST_WAITING} requests without an answer")
        return seen

    def end_request(self, seen: Seen, size: int) -> None:
        seen.up_bytes = size
        if not seen.answer_ns:  # else the server did not wait for the request's end
            seen.sent_ns = self.to_ns

    def begin_answer(self) -> Seen | None:
        """Return the exchange whose answer these bytes belong to, None for bytes without a request."""
        if not self._waiting:
            return None
        seen = self._waiting[0]
        seen.answer_ns = seen.answer_ns or self.from_ns
        seen.sent_ns = seen.sent_ns or self.from_ns
        return seen

    def piece(self, seen: Seen) -> None:
        """Count these bytes as a token or a partial action."""
        if len(seen.pieces_ns) < MOST_PIECES:
            seen.pieces_ns.append(self.to_ns)

    def end_answer(self, seen: Seen, size: int) -> None:
        """End the exchange of `begin_answer`."""
        self._waiting.popleft()
        seen.end_ns, seen.down_bytes = self.to_ns, size
        self.report(seen)

    def end(self) -> None:
        """Report the requests that a connection ended without an answer to."""
        for seen in self._waiting:
            seen.error = seen.error or "the connection ended before the answer"
            self.report(seen)
        self._waiting.clear()


class TurnsReader(TapReader):
    """Any protocol, by turns: a request is what the client sends until the server does, the answer what follows."""

    def up(self, data: bytes) -> None:
        if self._waiting and self._waiting[0].end_ns:
            self.end()
        seen = self._waiting[0] if self._waiting else self.begin_request("turns")
        self.end_request(seen, seen.up_bytes + len(data))

    def down(self, data: bytes) -> None:
        if seen := self.begin_answer():
            seen.end_ns = self.to_ns
            seen.down_bytes += len(data)

    def end(self) -> None:
        if self._waiting and self._waiting[0].end_ns:
            self.report(self._waiting.popleft())
        super().end()


class Incoming:
    """The bytes of one direction for a parser that is a generator: ``yield from incoming.read(n)`` waits for them."""

    def __init__(self, parser: Callable[[Incoming], Generator[None, None, None]]) -> None:
        self._pieces: list[bytes] = []
        self._at = self._there = self._unwanted = 0
        """Bytes of the first piece that were read, those there to read, and those to come that are unwanted."""
        self._parser = parser(self)
        next(self._parser)

    def feed(self, data: bytes) -> None:
        if self._unwanted > len(data):  # bytes that nothing reads are not copied
            self._unwanted -= len(data)
            return
        data, self._unwanted = data[self._unwanted :], 0
        self._pieces.append(data)
        self._there += len(data)
        next(self._parser)

    def begin(self) -> Generator[None, None, int]:
        """Wait for a byte, and return it; it stays to be read."""
        while not self._there:
            yield
        return self._joined()[self._at]

    def read(self, size: int) -> Generator[None, None, bytes]:
        if size > MOST_BYTES:
            raise ValueError(f"a message of {size} bytes, more than {MOST_BYTES}")
        while self._there < size:
            yield
        whole, at = self._joined(), self._at
        self._drop(size)
        return whole[at : at + size]

    def skip(self, size: int) -> Generator[None, None, None]:
        """Drop bytes as they come."""
        there = min(size, self._there)
        self._drop(there)
        self._unwanted = size - there
        while self._unwanted:
            yield

    def _joined(self) -> bytes:
        """Join the bytes that are there, without a copy if they came together."""
        if len(self._pieces) > 1:
            first, *others = self._pieces
            self._pieces, self._at = [b"".join((memoryview(first)[self._at :], *others))], 0
        return self._pieces[0] if self._pieces else b""

    def _drop(self, size: int) -> None:
        self._there -= size
        if self._there:
            self._joined()
            self._at += size
        else:
            self._pieces, self._at = [], 0


class ParsedTapReader(TapReader):
    """A reader whose directions are parsed by a generator each, `messages`."""

    def __init__(self, report: Callable[[Seen], None], kinds: set[str]) -> None:
        super().__init__(report, kinds)
        self._up = Incoming(lambda incoming: self.messages(incoming, up=True))
        self._down = Incoming(lambda incoming: self.messages(incoming, up=False))

    def up(self, data: bytes) -> None:
        self._up.feed(data)

    def down(self, data: bytes) -> None:
        self._down.feed(data)

    def messages(self, incoming: Incoming, *, up: bool) -> Generator[None, None, None]:
        raise NotImplementedError
