"""Hostile peers of our policy server and client over WebSocket."""

from __future__ import annotations

import re
from typing import Any

import msgpack
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key

from s2a_bench.plugins.policy_servers.websocket.codec import OURS
from tests.hostile.suite import FAILED, Attack, Case, Trap
from tests.hostile.tcp import CLIENTS as ANY_CLIENT
from tests.hostile.tcp import NOISE, Block, answers, crowd, sends, sends_made, servers
from tests.hostile.wires.http import CONTROL, bomb

SCHEME = "ws://"
KEY = "dGhlIHNhbXBsZSBub25jZQ=="


def upgrade(*headers: str) -> bytes:
    """Return a handshake."""
    lines = ["GET / HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"]
    lines += [f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: 13", *headers, "", ""]
    return "\r\n".join(lines).encode()


def frame(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True, mask: bool = True) -> bytes:
    """Return a frame as a client sends it."""
    return Frame(opcode, data, fin=fin).serialize(mask=mask)


def announced(length: int, *, mask: bool = True) -> bytes:
    """Return the beginning of a frame that says that it will be so long."""
    return b"\x82" + bytes([127 | mask << 7]) + length.to_bytes(8, "big") + b"mask" * mask


def array(data: bytes, shape: Any) -> dict[bytes, Any]:
    """Return what stands for an array."""
    return {b"__ndarray__": True, b"data": data, b"dtype": "<f4", b"shape": shape}


def says(value: Any) -> bytes:
    """Return an observation in a frame."""
    return frame(msgpack.packb(value))


def asked(*pieces: bytes, **more: Any) -> Attack:
    """Return a client that shakes hands and sends pieces."""
    return sends(upgrade(), *pieces, **more)


GO = says({"prompt": "go on"})
NO_MESSAGE = "that are no message"

CLIENTS: tuple[Case[Attack], ...] = (
    *ANY_CLIENT,
    Case(
        "a handshake a byte at a time",
        sends(*(bytes([byte]) for byte in upgrade()[:-2] + b"x: " + b"a" * 300), every_s=0.05),
        "^$",
    ),
    Case("1 MiB of headers", sends(upgrade()[:-2], *[b"x-%d: %s\r\n" % (n, b"a" * 100) for n in range(10_000)])),
    Case("a page of a browser", sends(upgrade("Origin: https://example.org")), "^HTTP/1.1 403 "),
    Case(
        "1 GiB announced in a frame", asked(announced(1 << 30), NOISE, first=1), "exceeds limit|too big|over size limit"
    ),
    Case("a picture of 900 million pixels", sends_made(lambda: [upgrade(), says({"image": bomb()})]), "IMAGE_PIXELS"),
    Case("200 requests in one piece", asked(GO * 200), "actions"),
    Case("gone in the middle of an answer", asked(GO, then="goes")),
    Case("100 clients at once", crowd(100, asked(GO)), "actions"),
)


def accepted(heard: bytes) -> bytes:
    """Return the answer to a handshake."""
    key = re.search(rb"Sec-WebSocket-Key: (\S+)", heard, re.IGNORECASE)
    accept = accept_key(key[1].decode() if key else "")
    head = ["HTTP/1.1 101 Switching Protocols", "Upgrade: websocket", "Connection: Upgrade"]
    return "\r\n".join([*head, f"Sec-WebSocket-Accept: {accept}", "", ""]).encode()


def tells(value: Any) -> bytes:
    """Return a server's message."""
    return frame(msgpack.packb(value), mask=False)


def _answers(*pieces: Block, **more: Any) -> Trap:
    return answers(*pieces, scheme=SCHEME, **more)


def _greets(*pieces: Block, **more: Any) -> Trap:
    """Return a server that shakes hands, greets as ours does, and then says what it says."""
    return _answers(accepted, tells({"server": OURS}), *pieces, **more)


CHUNK = {"actions": array(bytes(24), (2, 3))}

SERVERS: tuple[Case[Trap], ...] = (
    *servers(SCHEME),
    Case("a page", _answers(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi"), "^RequestFailed: .*answered 200: hi"),
    Case("a redirect", _answers(b"HTTP/1.1 302 Found\r\nLocation: ws://127.0.0.1:1/\r\n\r\n", then="goes"), FAILED),
    Case("an accept that fits nothing", _answers(lambda _: accepted(b"")), "^RequestFailed: .*Accept"),
    Case("a handshake, then silence", _answers(accepted), "^RequestFailed: .*silent"),
    Case("a greeting that is no message", _answers(accepted, frame(b"\xc1", mask=False)), NO_MESSAGE),
    Case("a greeting, then silence", _greets(), "^RequestFailed: .*silent"),
    Case("a chunk, then marks that are none", _greets(tells(CHUNK), tells({"s2a": [5]})), "marks is none"),
    Case("1 GiB announced in a frame", _greets(announced(1 << 30, mask=False), NOISE), FAILED),
    Case("an error that forges lines", _greets(frame(CONTROL.encode(), Opcode.TEXT, mask=False)), "all is well"),
    Case(
        "an error without end",
        _greets(
            frame(b"", Opcode.TEXT, fin=False, mask=False), again=[frame(NOISE, Opcode.CONT, fin=False, mask=False)]
        ),
        FAILED,
    ),
    Case("partial frames without end", _greets(again=[tells({"type": "partial", **CHUNK}) * 100]), FAILED),
)
