"""Both ends of the transport `toy`."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from threading import Thread
from typing import Any

import numpy as np
from s2a_bench.errors import EngineError, PortInUse, RequestFailed, ServerDied
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.pictures import bgr_of, rgb_of
from s2a_bench.types import Frame, Request, Token
from s2a_toy.transport import TOY_MESSAGES

LENGTH = struct.Struct("<I")
LIMIT = 1 << 20
"""Bytes of a message of the server: what is longer is refused before it is read."""


def send(connection: socket.socket, *parts: bytes | memoryview) -> None:
    """Send one message of several parts."""
    connection.sendall(LENGTH.pack(sum(len(part) for part in parts)))
    for part in parts:
        connection.sendall(part)


def receive(connection: socket.socket, limit: int = LIMIT) -> memoryview:
    """Return one message; raises EOFError where the peer has gone, ValueError for a length beyond the limit."""
    (length,) = LENGTH.unpack(_exactly(connection, LENGTH.size))
    if length > limit:
        raise ValueError(f"a message of {length} bytes is longer than {limit}")
    return _exactly(connection, length)


def _exactly(connection: socket.socket, length: int) -> memoryview:
    whole = memoryview(bytearray(length))
    got = 0
    while got < length:
        count = connection.recv_into(whole[got:])
        if not count:
            raise EOFError
        got += count
    return whole


class ToyClient:
    """Sends a request as one message and reads a message a token."""

    camera = None

    def __init__(self, wiring: Wiring[Any], alive: Callable[[], bool]) -> None:
        """Connect; raises ServerDied where nothing listens."""
        self._alive = alive
        self._address = wiring.address
        self._timeout_s = wiring.timeout_s
        self._connection = self._connect()

    def _connect(self) -> socket.socket:
        host, _, port = self._address.rpartition(":")
        try:
            connection = socket.create_connection((host, int(port)), timeout=self._timeout_s)
        except OSError as error:
            raise ServerDied(f"nothing answers at {self._address}: {error}") from error
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Send the request with its first picture, and yield the tokens."""
        pixels = [bgr_of(frame, trace) for frame in request.images[:1]]
        fields = {name: getattr(request, name) for name in ("id", "prompt", "max_tokens", "grammar", "seed")}
        sizes = [[frame.width, frame.height] for frame in pixels]
        header = json.dumps(fields | {"sizes": sizes}).encode()
        parts = [LENGTH.pack(len(header)), header, *(memoryview(frame.data.reshape(-1)) for frame in pixels)]
        trace.mark("toy_frame")
        trace.facts[PAYLOAD_BYTES] = sum(map(len, parts))
        done = False
        try:
            send(self._connection, *parts)
            for count, message in enumerate(self._messages(), 1):
                if "error" in message:
                    done = True
                    raise RequestFailed(str(message["error"]))
                if "remote" in message:
                    trace.receive(Remote(**message["remote"]))
                    trace.facts[TOY_MESSAGES] = float(count)
                    done = True
                    return
                if not message["index"]:
                    trace.mark("return")
                yield Token(message["index"], message["text"], message["id"])
        except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
            if not self._alive():
                raise ServerDied(f"the server at {self._address} has ended") from error
            raise RequestFailed(f"{self._address} broke off: {error or type(error).__name__}") from error
        finally:
            if not done:  # what was not read belongs to this request only
                self.close()
                with suppress(ServerDied):
                    self._connection = self._connect()

    def _messages(self) -> Iterator[dict[str, Any]]:
        while True:
            yield json.loads(bytes(receive(self._connection)))

    def describe(self) -> dict[str, str]:
        """Add nothing."""
        return {}

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


class ToyServer:
    """Answers each connection on a thread of its own."""

    def __init__(self, wiring: Wiring[Any], handler: Handler) -> None:
        """Bind; raises PortInUse."""
        host, _, port = (wiring.address or "127.0.0.1:0").rpartition(":")
        self._handler, self._limit = handler, wiring.limits.body_bytes
        try:
            self._listener = socket.create_server((host, int(port)))
        except OSError as error:
            raise PortInUse(f"`toy_port`: {port} cannot be had on {host}: {error.strerror}") from error
        self.address = "{}:{}".format(*self._listener.getsockname())
        self._stopped = False

    def describe(self) -> dict[str, str | int]:
        """Return what serves."""
        return {"server": "toy"}

    def serve(self) -> None:
        """Serve until stopped."""
        while not self._stopped:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            Thread(target=self._answer_all, args=(connection,), daemon=True).start()

    def stop(self) -> None:
        """Stop listening."""
        self._stopped = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _answer_all(self, connection: socket.socket) -> None:
        with connection, suppress(OSError, EOFError, ValueError):
            while True:
                message = receive(connection, self._limit)
                trace = Trace()
                trace.mark("network")
                self._answer(connection, message, trace)

    def _answer(self, connection: socket.socket, message: memoryview, trace: Trace) -> None:
        (length,) = LENGTH.unpack(message[: LENGTH.size])
        fields = json.loads(bytes(message[LENGTH.size : LENGTH.size + length]))
        pixels = np.frombuffer(message, np.uint8, offset=LENGTH.size + length)
        frames = [
            Frame(-1, 0, width, height, "bgr8", pixels.reshape(height, width, 3))
            for width, height in fields.pop("sizes")
        ]
        trace.mark("toy_unframe")
        images = tuple(rgb_of(frame, trace) for frame in frames)
        tokens = self._handler(Request(images=images, **fields), trace)
        try:
            for token in tokens:
                told = {"index": token.index, "text": token.text, "id": token.id}
                send(connection, json.dumps(told).encode())
        except EngineError as error:
            send(connection, json.dumps({"error": str(error)}).encode())
            return
        finally:
            tokens.close()
        send(connection, json.dumps({"remote": asdict(trace.to_remote())}).encode())
