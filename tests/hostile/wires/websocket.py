"""Hostile peers of our policy server and client over WebSocket."""

from __future__ import annotations

import re
from typing import Any

import msgpack
import numpy as np
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key

from s2a_bench.plugins.policy_servers.websocket.codec import OURS
from tests.hostile.suite import FAILED, Attack, Case, Trap
from tests.hostile.tcp import CLIENTS as ANY_CLIENT
from tests.hostile.tcp import NOISE, Block, answers, crowd, sends, sends_made, servers
from tests.hostile.wires.http import CONTROL, MIB, bomb

SCHEME = "ws://"
KEY = "dGhlIHNhbXBsZSBub25jZQ=="


def upgrade(*headers: str, path: str = "/", version: str = "13", line: str = "") -> bytes:
    """Return a handshake."""
    lines = [line or f"GET {path} HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"]
    lines += [f"Sec-WebSocket-Key: {KEY}", f"Sec-WebSocket-Version: {version}", *headers, "", ""]
    return "\r\n".join(lines).encode()


def frame(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True, mask: bool = True) -> bytes:
    """Return a frame as a client sends it."""
    return Frame(opcode, data, fin=fin).serialize(mask=mask)


def announced(length: int, *, mask: bool = True) -> bytes:
    """Return the beginning of a frame that says that it will be so long."""
    return b"\x82" + bytes([127 | mask << 7]) + length.to_bytes(8, "big") + b"mask" * mask


def array(data: bytes = bytes(8), dtype: Any = "<f4", shape: Any = (2,)) -> dict[bytes, Any]:
    """Return what stands for an array."""
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}


def says(value: Any) -> bytes:
    """Return an observation in a frame."""
    return frame(msgpack.packb(value))


def asked(*pieces: bytes, **more: Any) -> Attack:
    """Return a client that shakes hands and sends pieces."""
    return sends(upgrade(), *pieces, **more)


def floods(small: bytes, *before: bytes) -> Attack:
    """Return a client that sends 6 MB of small frames on one connection."""
    return sends_made(lambda: [upgrade(), *before, *[small * 1000] * 1000])


GO = says({"prompt": "go on"})
FLOODS = {
    "pings": floods(frame(b"", Opcode.PING)),
    "fragments of a byte": floods(frame(b"a", Opcode.CONT, fin=False), frame(b"", fin=False)),
}
NO_MESSAGE = "that are no message"

CLIENTS: tuple[Case[Attack], ...] = (
    *ANY_CLIENT,
    Case(
        "a handshake a byte at a time",
        sends(*(bytes([byte]) for byte in upgrade()[:-2] + b"x: " + b"a" * 300), every_s=0.05),
        "^HTTP/1.1 408 |^$",
    ),
    Case("1 MiB of headers", sends(upgrade()[:-2], *[b"x-%d: %s\r\n" % (n, b"a" * 100) for n in range(10_000)])),
    Case("a page of a browser", sends(upgrade("Origin: https://example.org")), "^HTTP/1.1 403 "),
    Case("a frame without a mask", asked(frame(b"abc", mask=False)), "incorrect masking"),
    Case("1 GiB announced in a frame", asked(announced(1 << 30), NOISE), "too big|over size limit|exceeds limit|bytes"),
    *(Case(f"{name} without end", flood) for name, flood in FLOODS.items()),
    Case(
        "fragments of 1 MiB without end",
        sends_made(lambda: [upgrade(), frame(b"", fin=False), *[frame(bytes(MIB), Opcode.CONT, fin=False)] * 256]),
    ),
    Case(
        "pings whose pongs nobody reads", sends_made(lambda: [upgrade(), *[frame(bytes(99), Opcode.PING) * 999] * 999])
    ),
    Case("60 MiB of zeros", sends_made(lambda: [upgrade(), frame(bytes(60 * MIB))]), NO_MESSAGE),
    Case(
        "a picture of 900 million pixels",
        sends_made(lambda: [upgrade(), says({"image": bomb()})]),
        "IMAGE_PIXELS",
    ),
    Case("200 requests in one piece", asked(GO * 200), "actions|more than two requests at once|HTTP/1.1 101 "),
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


CHUNK = {"actions": array(np.zeros(6, np.float32).tobytes(), shape=(2, 3))}

SERVERS: tuple[Case[Trap], ...] = (
    *servers(SCHEME),
    Case("a page", _answers(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi"), "^RequestFailed: .*answered 200: hi"),
    Case("a redirect", _answers(b"HTTP/1.1 302 Found\r\nLocation: ws://127.0.0.1:1/\r\n\r\n", then="goes"), FAILED),
    Case("a refusal of 4 GiB", _answers(b"HTTP/1.1 500 No\r\n\r\n", again=[b"no " * (1 << 15)]), FAILED),
    Case("endless headers", _answers(b"HTTP/1.1 101 Yes\r\n", again=[b"x: y\r\n" * 1000]), FAILED),
    Case("an accept that fits nothing", _answers(lambda _: accepted(b"")), "^RequestFailed: .*Accept"),
    Case("a handshake, then silence", _answers(accepted), "^RequestFailed: .*silent"),
    Case("a greeting that is no message", _answers(accepted, frame(b"\xc1", mask=False)), NO_MESSAGE),
    Case("a greeting, then silence", _greets(), "^RequestFailed: .*silent"),
    Case("a chunk, then marks that are none", _greets(tells(CHUNK), tells({"s2a": [5]})), "marks is none"),
    Case("a frame with a mask", _greets(frame(msgpack.packb(CHUNK))), "^RequestFailed: .*masking"),
    Case("1 GiB announced in a frame", _greets(announced(1 << 30, mask=False), NOISE), FAILED),
    Case("an error that forges lines", _greets(frame(CONTROL.encode(), Opcode.TEXT, mask=False)), "all is well"),
    Case(
        "an error without end",
        _greets(
            frame(b"", Opcode.TEXT, fin=False, mask=False), again=[frame(NOISE, Opcode.CONT, fin=False, mask=False)]
        ),
        FAILED,
    ),
    Case("pings without end", _greets(again=[frame(b"", Opcode.PING, mask=False) * 1000]), FAILED),
    Case(
        "a chunk of 100,000 actions",
        _greets(tells({"actions": array(bytes(400_000), shape=(100_000, 1))})),
        "^RequestFailed: .*does not stop",
    ),
    Case("partial frames without end", _greets(again=[tells({"type": "partial", **CHUNK}) * 100]), FAILED),
)
