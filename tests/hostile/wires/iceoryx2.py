"""Hostile clients of our iceoryx2 server; all are programs of its user, which alone can join."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.plugins.iceoryx2.wire import HEAD, POLL_S, SLICE, Domain, bytes_in, wait
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring, open_client
from s2a_bench.types import Request
from tests.hostile.peers import CLOSED, PATIENCE_S, Attack, Case
from tests.hostile.wires.http import bomb

CLIENT = 7
"""All these clients say that they are one and the same, which they are."""


@contextmanager
def joined(name: str) -> Iterator[tuple[Any, Any, Any]]:
    """Join a server's service below our client: yield the port of requests, what wakes the server, and a listener."""
    domain = Domain()
    try:
        event = domain.event(name, CLIENT).open_or_create()
        service = domain.requests(name).open()
        port = service.client_builder().initial_max_slice_len(1 << 20).create()
        yield port, domain.event(name).open().notifier_builder().create(), event.listener_builder().create()
        del event, service, port
    finally:
        domain.leave()


def asks(body: bytes, length: int | None = None, *, head: bytes | None = None) -> Attack:
    """Return a client that sends a header, whose length may be a lie, and what lies behind it; it hears the answer."""

    def attack(wiring: Wiring[Any], _: str) -> str:
        request = (HEAD.pack(0, CLIENT, 1, len(body) if length is None else length) if head is None else head) + body
        with joined(wiring.address) as (port, wake, listener):
            lent = port.loan_slice_uninit(len(request))
            bytes_in(lent)[:] = request
            pending, ends = lent.assume_init().send(), now_ns() + round(PATIENCE_S * 1e9)
            wake.notify()
            while now_ns() < ends:
                connected, answer = pending.is_connected, pending.receive()
                if answer is not None:
                    return bytes(bytes_in(answer)[SLICE.size :]).decode()
                if not connected:
                    return CLOSED
                wait(listener, POLL_S)
        raise TimeoutError

    return attack


def leaves(pieces: int) -> Attack:
    """Return a client that asks for many tokens, reads so many, and closes."""

    def attack(wiring: Wiring[Any], _: str) -> str:
        with closing(open_client(wiring)) as client:
            answer = client.request(Request("gone", "go", max_tokens=60_000), Trace())
            for _piece in range(pieces):
                next(answer)
        return CLOSED

    return attack


def fields(**more: Any) -> bytes:
    """Return a header."""
    plain = {"id": "a", "prompt": "go", "max_tokens": 2, "grammar": "", "seed": 0, "images": [], "state": []}
    return json.dumps({**plain, **more}).encode()


def picture(**more: Any) -> bytes:
    """Return a header with one picture of 4x2."""
    sides = {"width": 4, "height": 2, **more}
    kind = ";".join(("application/x-raw", "encoding=bgr8", *(f"{side}={length}" for side, length in sides.items())))
    return fields(images=[{"type": kind, "bytes": 24}])


BOMB = fields(images=[{"type": "image/png", "bytes": len(bomb())}])
CLIENTS = (
    Case("gone at once", leaves(0)),
    Case("gone in mid-answer", leaves(3)),
    Case("no head", asks(b"abc", head=b""), CLOSED),
    Case("no JSON", asks(b"{]" * 50), "internal error"),
    Case("deep JSON", asks(b"[" * (1 << 19)), "internal error"),
    Case("a header beyond the end", asks(fields(), 1 << 60), "internal error|go"),
    Case("half a surrogate pair", asks(fields().replace(b'"go"', b'"\\ud800"')), "internal error|surrogate"),
    Case("max_tokens 2^40", asks(fields(max_tokens=1 << 40)), "max_tokens"),
    Case("a state of texts", asks(fields(state=["x"])), "the state"),
    Case("a picture of other sides", asks(picture(width=5) + bytes(24), len(picture(width=5))), "not such a picture"),
    Case("a picture that is not there", asks(picture()), "not such a picture"),
)
LARGE = (Case("a picture of 900 million pixels", asks(BOMB + bomb(), len(BOMB)), "pixels"),)
