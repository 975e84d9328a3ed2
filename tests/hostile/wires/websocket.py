"""Hostile peers of our policy server and client over WebSocket."""

from __future__ import annotations

import re
import socket
from typing import Any

import msgpack
import numpy as np
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key

from s2a_bench.plugins.policy_servers.websocket.codec import OURS
from tests.hostile.peers import CLOSED, FORGED, MIB, NOISE, Attack, Case, Server, Step, Trap, answers, crowd, sends
from tests.hostile.wires.http import bomb

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


def array(data: bytes = bytes(8), dtype: Any = "<f4", shape: Any = (2,)) -> dict[bytes, Any]:
    """Return what stands for an array."""
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}


def says(value: Any, *, mask: bool = True) -> bytes:
    """Return a message in a frame."""
    return frame(msgpack.packb(value), mask=mask)


def asks(*pieces: Any, **more: Any) -> Attack:
    """Return a client that shakes hands and sends pieces."""
    return sends(upgrade(), *pieces, **more)


GO = says({"prompt": "go on"})
ERROR = "that are not a message|not such a picture|error|Error"
LINES = [b"x-%d: %s\r\n" % (n, b"a" * 100) for n in range(10_000)]
FRAGMENT = frame(bytes(MIB), Opcode.CONT, fin=False)

CLIENTS = (
    Case("noise", sends(NOISE), CLOSED),
    Case("half a handshake", sends(upgrade()[:60], then="leaves")),
    Case("another path of HTTP", sends(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}"), CLOSED),
    Case("a frame without a mask", asks(frame(b"abc", mask=False)), CLOSED),
    Case("a frame of no kind", asks(b"\x8f\x80mask"), CLOSED),
    Case("no MessagePack", asks(frame(b"\xc1")), ERROR),
    Case("deep MessagePack", asks(frame(b"\x91" * 5000)), ERROR),
    Case("a text that is no UTF-8", asks(frame(b"\xff\xfe", Opcode.TEXT)), f"{ERROR}|{CLOSED}"),
    Case("an array of objects", asks(says({"state": array(dtype="|O")})), ERROR),
    Case("pixels that are not there", asks(says({"image": array(b"", "|u1", (480, 640, 3))})), ERROR),
    Case("200 requests in one piece", asks(GO * 200), "actions|at once"),
    Case("gone in the middle of an answer", asks(GO, then="leaves")),
    Case("100 that come and go", crowd(100, asks(GO, then="resets"))),
)
LARGE = (
    Case("1 GiB announced in a frame", asks(announced(1 << 30), NOISE), CLOSED),
    Case("256 MiB in fragments", asks(frame(b"", fin=False), *[FRAGMENT] * 256), CLOSED),
    Case("60 MiB of zeros", asks(lambda: frame(bytes(60 * MIB))), ERROR),
    Case("1 MiB of headers", sends(upgrade()[:-2], *LINES), CLOSED),
    Case("pings whose pongs nobody reads", asks(*[frame(bytes(99), Opcode.PING) * 999] * 20, then="leaves")),
    Case("a picture of 900 million pixels", asks(lambda: says({"image": bomb()})), ERROR),
    Case("300 connections at once", crowd(300, asks(GO)), f"actions|at once|open already|{CLOSED}"),
)


def accepted(_connection: socket.socket, heard: bytes) -> bytes:
    """Return the answer to a handshake."""
    key = re.search(rb"Sec-WebSocket-Key: (\S+)", heard, re.IGNORECASE)
    accept = accept_key(key[1].decode() if key else "")
    head = ["HTTP/1.1 101 Switching Protocols", "Upgrade: websocket", "Connection: Upgrade"]
    return "\r\n".join([*head, f"Sec-WebSocket-Accept: {accept}", "", ""]).encode()


def greets(*steps: Step, **more: Any) -> Trap:
    """Return a server that shakes hands, greets as ours does, and then says what it says."""
    return answers(accepted, says({"server": OURS}, mask=False), *steps, **more)


CHUNK = {"actions": array(np.zeros(6, np.float32).tobytes(), shape=(2, 3))}
SERVERS = (
    Server("silence", answers(), timeout_s=0.5),
    Server("noise", answers(NOISE)),
    Server("a page", answers(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi"), "^RequestFailed: .*answered 200"),
    Server("endless headers", answers(b"HTTP/1.1 101 Yes\r\n", again=b"x: y\r\n" * 1000), timeout_s=0.5),
    Server("an accept that fits nothing", answers(lambda *_: accepted(*_[:1], b"")), "^RequestFailed: .*Accept"),
    Server("a greeting that is no message", answers(accepted, frame(b"\xc1", mask=False)), "not a message"),
    Server("a greeting, then silence", greets(), "^RequestFailed: .*silent", timeout_s=0.5),
    Server("a frame with a mask", greets(frame(msgpack.packb(CHUNK))), timeout_s=0.5),
    Server("marks that are none", greets(says(CHUNK, mask=False), says({"s2a": [5]}, mask=False)), "marks"),
    Server("1 GiB announced in a frame", greets(announced(1 << 30, mask=False), NOISE)),
    Server("a forged line", greets(frame(FORGED.encode(), Opcode.TEXT, mask=False)), "all is well"),
    Server("endless pings", greets(again=frame(b"", Opcode.PING, mask=False) * 1000), timeout_s=0.5),
)
