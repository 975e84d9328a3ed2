"""Raw HTTP/1.1 servers on threads: exact bytes in exact pieces, whatever they are."""

from __future__ import annotations

import json
import socket
import socketserver
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Thread
from typing import Any


@dataclass(frozen=True)
class Received:
    """One request as it came."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


Reply = Callable[[Received], Iterable[bytes]]
"""What a server answers: pieces, each sent by itself. `CLOSE` closes the connection."""

CLOSE = b"\0close"


def head(status: str = "200 OK", kind: str = "text/event-stream", *more: str) -> bytes:
    """The head of a response that ends with its connection."""
    lines = [f"HTTP/1.1 {status}", f"Content-Type: {kind}", *more, "Connection: close"]
    return "\r\n".join([*lines, "", ""]).encode()


def kept_head(kind: str) -> bytes:
    """The head of a chunked response on a connection that is kept."""
    return f"HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nTransfer-Encoding: chunked\r\n\r\n".encode()


def chunk(data: bytes) -> bytes:
    """One chunk; an empty one ends the body."""
    return b"%x\r\n%s\r\n" % (len(data), data)


@contextmanager
def serving(reply: Reply, port: int = 0) -> Iterator[str]:
    """Serve on a port of 127.0.0.1, by default a free one; yields the base URL."""

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with suppress(ConnectionError):
                while (received := _request(self.rfile)) is not None:
                    closes = False
                    for piece in reply(received):
                        if piece == CLOSE:
                            return
                        self.connection.sendall(piece)
                        closes = closes or b"Connection: close" in piece
                    if closes:
                        return

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        allow_reuse_address = True

    with Server(("127.0.0.1", port), Handler) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def _request(stream: Any) -> Received | None:
    first = stream.readline().decode()
    if not first:
        return None
    method, path, _ = first.split(" ")
    headers = {}
    while line := stream.readline().decode().strip():
        name, _, value = line.partition(":")
        headers[name.lower()] = value.strip()
    return Received(method, path, headers, stream.read(int(headers.get("content-length", 0))))
