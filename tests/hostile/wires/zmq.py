"""Hostile peers of our ZeroMQ server and client: any over TCP, and some that greet as ZMTP wants it."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any

import msgpack
import numpy as np

from s2a_bench.plugins.policy_servers.zmq.wire import file_of
from s2a_bench.transport import Wiring
from tests.hostile.suite import FAILED, PATIENCE_S, Attack, Case, Trap
from tests.hostile.tcp import CLIENTS as ANY_CLIENT
from tests.hostile.tcp import NOISE, answers, crowd, sends, servers
from tests.hostile.wires.http import CONTROL, MIB

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""ZMTP 3.0 without security."""


def command(name: bytes, data: bytes = b"") -> bytes:
    """Return a command."""
    body = bytes([len(name)]) + name + data
    return bytes([4, len(body)]) + body


def ready(kind: bytes) -> bytes:
    """Return a greeting and what follows it, for a socket of a kind."""
    return GREETING + command(b"READY", b"\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind)


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


def request(data: Any = None, **fields: Any) -> bytes:
    """Return a request for actions."""
    return packed({"endpoint": "get_action", "data": data if data is not None else {}, **fields})


def asks(*bodies: bytes, **more: Any) -> Attack:
    """Return a client that greets as a REQ socket, and sends one message once the server has greeted, too.

    libzmq breaks with a peer that speaks before its own greeting is out.
    """
    return sends(ready(b"REQ"), message(*bodies), first=len(GREETING), **{"seconds": 0.5, **more})


REFUSED = "error"
FLOOD = frame(b"", more=True) * 100_000 + frame(b"")

CLIENTS: tuple[Case[Attack], ...] = (
    *ANY_CLIENT,
    Case("half a message, then silence", sends(ready(b"REQ"), message(request())[:-5], seconds=1, first=len(GREETING))),
    Case(
        "1 GiB announced in a frame",
        sends(ready(b"REQ"), frame(b"", more=True), frame(bytes(MIB), said=1 << 30), first=len(GREETING)),
    ),
    Case("100,000 frames before the message", sends(ready(b"REQ"), FLOOD, seconds=1, first=len(GREETING))),
    Case("noise", asks(NOISE), REFUSED),
    Case("an endpoint that is none", asks(packed({"endpoint": CONTROL})), r"Unknown endpoint: '\\x1b"),
    Case("states without end", asks(request({"state.a": npy(file_of(np.zeros(1 << 20, np.float32)))})), REFUSED),
    Case("gone without waiting", asks(request({}), then="resets")),
    Case(
        "100 clients at once",
        crowd(100, sends(ready(b"REQ"), message(request({})), seconds=2, first=len(GREETING))),
        "robot|error",
    ),
    Case(
        "1000 requests of one who reads nothing",
        sends(ready(b"DEALER"), message(request({})) * 1000, then="goes", first=len(GREETING)),
    ),
)


def converses(*pieces: bytes) -> Trap:
    """Return a server that greets as a REP socket, hears a request out, answers with pieces, and listens."""

    def serve(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                Thread(target=talk, args=(connection,), daemon=True).start()

    def talk(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            connection.settimeout(PATIENCE_S * 5)
            connection.sendall(ready(b"REP"))
            heard = b""
            while b"get_action" not in heard and (data := connection.recv(1 << 16)):
                heard += data
            connection.sendall(b"".join(pieces))
            while connection.recv(1 << 16):
                pass

    @contextmanager
    def trap(_: Wiring[Any]) -> Iterator[str]:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            Thread(target=serve, args=(listener,), daemon=True).start()
            try:
                yield "tcp://{}:{}".format(*listener.getsockname())
            finally:
                listener.shutdown(socket.SHUT_RDWR)

    return trap


MOVES = message(packed([{"robot": np.zeros((1, 4, 7), np.float32)}, {}]))

SERVERS: tuple[Case[Trap], ...] = (
    *servers("tcp://"),
    Case("greeted, then silence", answers(ready(b"REP"), scheme="tcp://"), "^RequestFailed: .*silent"),
    Case("100,000 frames", converses(FLOOD), "100001 frames"),
    Case("noise", converses(message(NOISE)), FAILED),
    Case("no actions", converses(message(packed([{}, {}]))), FAILED),
    Case("an error that forges lines", converses(message(packed({"error": CONTROL}))), "^RequestFailed: .*all is well"),
    Case("1 GiB announced in an answer", converses(frame(b"", more=True), frame(b"a", said=1 << 30)), FAILED),
    Case("actions, then silence where the marks belong", converses(MOVES), "^RequestFailed: .*silent"),
    Case("marks that are none", converses(MOVES, message(packed({"s2a": {"clock": 5}}))), "marks is none"),
)
