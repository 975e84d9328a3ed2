"""HTTP servers that never come to an end: one row a case, what a client says of it, and what it may cost."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat

from tests.servers.sockets import head

DIALECT = "openai"
MAX_TOKENS = 8
BATCH = 1 << 12
"""Messages that are sent at once: a test's server is slower than its client otherwise."""


@dataclass(frozen=True)
class Case:
    """One server: the pieces of its answer, the error of its client as a pattern, and what that costs at most."""

    pieces: Callable[[], Iterable[bytes]]
    says: str
    deadline_s: float = 0
    """``--deadline``; 0: its default."""
    seconds: float = 20
    mib: float = 64


def delta(**fields: object) -> bytes:
    """One chunk of a chat completion."""
    choice = {"index": 0, "delta": fields, "finish_reason": None}
    return b"data: " + json.dumps({"choices": [choice]}).encode() + b"\n\n"


def endless(message: bytes, *before: bytes) -> Callable[[], Iterator[bytes]]:
    """Good headers, then the same for ever, as fast as it goes."""

    def pieces() -> Iterator[bytes]:
        yield from before or (head(),)
        yield from repeat(message * BATCH)

    return pieces


def dripping(message: bytes, *before: bytes, every_s: float = 0.05) -> Callable[[], Iterator[bytes]]:
    """The same for ever, each a moment after the one before: no read is ever silent for long."""

    def pieces() -> Iterator[bytes]:
        yield from before
        while True:
            yield message
            time.sleep(every_s)

    return pieces


def bomb() -> Iterator[bytes]:
    """A gigabyte of tokens in a megabyte."""
    pack = zlib.compressobj(9, wbits=31)
    yield head("200 OK", "text/event-stream", "Content-Encoding: gzip")
    for _ in range(1 << 10):
        yield pack.compress(bytes(1 << 20))


UNENDED = head().removesuffix(b"\r\n")
CHUNKED = head("200 OK", "text/event-stream", "Transfer-Encoding: chunked")

BYTES = r"sent more than \d+ bytes for 8 tokens"
LATE = r"did not end its answer within 1 s; see `deadline` and `max_tokens`"

CASES: dict[str, Case] = {
    "tokens": Case(endless(delta(content="go ")), BYTES),
    "tokens, slowly": Case(dripping(delta(content="go "), head()), LATE, deadline_s=1),
    "roles": Case(endless(delta(role="assistant", content="")), BYTES),
    "thinking": Case(endless(delta(reasoning_content="hmm ")), BYTES),
    "comments": Case(endless(b": ping\n\n"), BYTES),
    "a line": Case(endless(b"x", head(), b"data: "), BYTES),
    "an event of many lines": Case(endless(b"data: x\n"), BYTES),
    "a token of megabytes": Case(lambda: [head(), delta(content="x" * (6 << 20))], BYTES),
    "bare JSON": Case(endless(b"[\n", head()), BYTES),
    "headers": Case(endless(b"X-More: x\r\n", UNENDED), "broke the connection"),
    "the size of a chunk": Case(endless(b"0", CHUNKED), "broke the connection"),
    "a refusal": Case(endless(b"no ", head("400 Bad Request", "text/plain")), BYTES),
    "a refusal, slowly": Case(dripping(b"no ", head("400 Bad Request", "text/plain")), LATE, deadline_s=1),
    "another media type": Case(endless(b"<p>", head(kind="text/html")), BYTES),
    "a compressed gigabyte": Case(bomb, r"compressed its answer \(gzip\)"),
    "nothing": Case(lambda: (time.sleep(3), head())[1:], LATE, deadline_s=1),
}
