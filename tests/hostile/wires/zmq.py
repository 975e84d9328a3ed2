"""Hostile peers of our ZeroMQ server and client, some of which greet as ZMTP wants it."""

from __future__ import annotations

import struct
from typing import Any

import msgpack
import numpy as np

from s2a_bench.plugins.policy_servers.zmq.wire import file_of
from tests.hostile.peers import CLOSED, FORGED, MIB, NOISE, Attack, Case, Server, Trap, answers, crowd, hears, sends
from tests.hostile.wires.http import bomb

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""ZMTP 3.0 without security."""


def ready(kind: bytes) -> bytes:
    """Return a greeting and what follows it, for a socket of a kind."""
    name, data = b"READY", b"\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    body = bytes([len(name)]) + name + data
    return GREETING + bytes([4, len(body)]) + body


def frame(body: bytes, *, more: bool = False, said: int | None = None) -> bytes:
    """Return a frame, whose length may be a lie."""
    return bytes([2 | more]) + struct.pack(">Q", len(body) if said is None else said) + body


def message(*bodies: bytes) -> bytes:
    """Return a message as REQ and REP send it: nothing, then its frames."""
    frames = [frame(body, more=place < len(bodies) - 1) for place, body in enumerate(bodies)]
    return frame(b"", more=True) + b"".join(frames)


def packed(value: Any) -> bytes:
    """Return a value as MessagePack, arrays as GR00T has them."""
    made: bytes = msgpack.packb(value, default=lambda array: npy(file_of(array)))
    return made


def npy(file: Any) -> dict[str, Any]:
    """Return what stands for an array, whose file may be anything."""
    return {"__ndarray_class__": True, "as_npy": file}


def request(data: Any, **fields: Any) -> bytes:
    """Return a request for actions."""
    return packed({"endpoint": "get_action", "data": data, **fields})


def greets(*pieces: Any, kind: bytes = b"REQ", **more: Any) -> Attack:
    """Return a client that greets; what follows comes after the server's greeting, or libzmq breaks with it."""
    return sends(ready(kind), *pieces, greeted=len(GREETING), **more)


REFUSED = "error"
MOVES = message(packed([{"robot": np.zeros((1, 4, 7), np.float32)}, {}]))

CLIENTS = (
    Case("noise", crowd(8, sends(NOISE)), CLOSED),
    Case("half a greeting", sends(GREETING[:20], then="leaves")),
    Case("half a message", greets(message(request({}))[:-5], then="resets")),
    Case("noise as a request", greets(message(NOISE)), REFUSED),
    Case("deep MessagePack", greets(message(b"\x91" * 5000)), REFUSED),
    Case("no endpoint", greets(message(packed({"endpoint": FORGED}))), "Unknown endpoint"),
    Case("max_tokens -1", greets(message(request({}, s2a={"max_tokens": -1}))), REFUSED),
    Case("an array that is no file", greets(message(request({"state.a": npy(NOISE)}))), REFUSED),
    Case("a picture of one number", greets(message(request({"video.a": np.zeros(1, np.uint8)}))), REFUSED),
    Case("gone without waiting", greets(message(request({})), then="resets")),
    Case("100 clients at once", crowd(100, greets(message(request({})))), "robot|error"),
)
LARGE = (
    Case("1 GiB announced", greets(frame(b"", more=True), frame(bytes(MIB), said=1 << 30)), CLOSED),
    Case("60 MiB of zeros as a picture", greets(lambda: message(request({"video.a": bytes(60 * MIB)}))), REFUSED),
    Case(
        "a picture of 900 million pixels",
        greets(lambda: message(request({"video.a": np.frombuffer(bomb(), np.uint8)}))),
        REFUSED,
    ),
    Case(
        "a million pictures", greets(lambda: message(request({"video.a": np.zeros((MIB, 1, 1, 3), np.uint8)}))), REFUSED
    ),
    Case("1000 requests, nothing read", greets(message(request({})) * 1000, kind=b"DEALER", then="leaves")),
)


def answered(*messages: bytes) -> Trap:
    """Return a server that greets as a REP socket, and answers the first request."""
    return answers(ready(b"REP"), hears(b"get_action"), *messages)


SERVERS = (
    Server("silence", answers(), "ZeroMQ peer", timeout_s=0.5),
    Server("noise", answers(NOISE), timeout_s=0.5),
    Server("greeted, then silence", answered(), "^RequestFailed: .*silent", timeout_s=0.5),
    Server("another kind of socket", answers(ready(b"PUB")), timeout_s=0.5),
    Server("noise as an answer", answered(message(NOISE))),
    Server("100,000 frames", answered(frame(b"", more=True) * 100_000 + frame(b"")), "frames"),
    Server("no actions", answered(message(packed([{}, {}])))),
    Server("actions of sentences", answered(message(packed([{"robot": [["a", "b"]]}, {}])))),
    Server("a forged line", answered(message(packed({"error": FORGED}))), "all is well"),
    Server("an error of 15 MiB", answered(message(packed({"error": "no " * 5 * MIB})))),
    Server("1 GiB announced", answered(frame(b"a", said=1 << 30)), timeout_s=0.5),
    Server("marks that are none", answered(MOVES, message(packed({"s2a": 5}))), "marks|silent", timeout_s=0.5),
)
