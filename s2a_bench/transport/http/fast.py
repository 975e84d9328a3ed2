"""The server of *best effort* and *binary*: one thread for each connection, blocking sockets, no framework.

httptools parses the head of a request, which must give the body's length; the body is read straight into its array.
A client that is silent for `Limits.head_s` within a head, or for `body_s` within a body, is given up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from http import HTTPStatus
from socket import IPPROTO_TCP, TCP_NODELAY
from typing import Any, Final

import httptools
import numpy as np

from s2a_bench.errors import S2AError
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import WebServer
from s2a_bench.transport.connections import LINGER_S, Connections, Wire, wait_at_most
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import ChatExchange, Reads, of_json, of_picture
from s2a_bench.transport.http.native import Refused
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import Limits
from s2a_bench.types import Request

PIECE: Final = 1 << 16
END: Final = b"\r\n\r\n"
CONTINUE: Final = b"HTTP/1.1 100 Continue\r\n\r\n"
READS: Final[Mapping[str, Reads]] = {
    native.PATHS[native.AS_DEPLOYED]: of_json,  # the usual path of OpenAI's clients
    native.PATHS[native.BEST_EFFORT]: of_json,
    native.PATHS[native.BINARY]: of_picture,
}


class Head:
    """A request's head, parsed from its bytes with the empty line; raises Refused."""

    def __init__(self, data: bytes) -> None:
        self.headers: list[tuple[str, str]] = []
        self._url, self._complete = b"", False
        parser = httptools.HttpRequestParser(self)
        try:
            parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass  # a server may ignore it (RFC 9110, 7.8)
        except httptools.HttpParserError as error:
            raise Refused(HTTPStatus.BAD_REQUEST, f"not an HTTP request: {error}") from error
        if not self._complete:
            raise Refused(HTTPStatus.BAD_REQUEST, "not an HTTP request")
        self.method, self.path = parser.get_method(), self._url.partition(b"?")[0].decode("latin-1")
        self.chunked = parser.get_http_version() == "1.1"
        self.keep = self.chunked and "close" not in self.value("connection").lower()

    def on_url(self, url: bytes) -> None:
        self._url += url

    def on_header(self, name: bytes, value: bytes) -> None:
        self.headers.append((name.decode("latin-1").lower(), value.decode("latin-1")))

    def on_headers_complete(self) -> None:
        self._complete = True

    def value(self, name: str) -> str:
        """Return the value of a header; several are joined to a list (RFC 9110, 5.3)."""
        return ", ".join(value for header, value in self.headers if header == name)

    def body_bytes(self, most: int) -> int:
        """Return the length of the body; raises Refused if it is not given, or too large."""
        if self.value("transfer-encoding"):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "the length of a body is needed: Content-Length")
        length = int(self.value("content-length") or 0)  # one number below 2^64, as the parser has checked
        if length > most:
            raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body is larger than {most} bytes")
        return length


class FastServer(WebServer):
    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        super().__init__(wiring, handler, "http", native.SCHEME)
        most = wiring.limits.connections
        full = Refused(HTTPStatus.SERVICE_UNAVAILABLE, f"{most} connections are open already", {"retry-after": "1"})
        connections = Connections(self._listener, self._answer_all, most, full.answer)
        self.serve, self.stop = connections.serve, connections.stop

    def describe(self) -> dict[str, str | int]:
        return {"server": "a thread a connection", "http": "httptools", "version": httptools.__version__}

    def _answer_all(self, wire: Wire) -> None:
        wire.socket.setsockopt(IPPROTO_TCP, TCP_NODELAY, 1)  # Nagle would hold a token until the last is acknowledged
        early: bytes | None = b""
        try:
            while early is not None:
                with ExitStack() as held:
                    early = self._answer(wire, early, held)
        except (Refused, S2AError) as error:
            refused = error if isinstance(error, Refused) else Refused(*native.refusal_of(error))
            wire.sendall(refused.answer)
            wire.linger()

    def _answer(self, wire: Wire, early: bytes, held: ExitStack) -> bytes | None:
        """Answer one request that begins with ``early``; return the first bytes of the next, None to close."""
        count = held.enter_context(self._core.in_flight.counted())
        data, rest = self._head(wire, early)
        if not data:
            return None
        head, limits = Head(data), self._core.limits
        native.admit(self._access, head.path, head.headers)
        size = head.body_bytes(limits.body_bytes)
        if (page := self._page(head)) is not None and not size:
            wire.sendall(page)
            wire.flush(LINGER_S)
            return rest if head.keep else None
        reads = READS.get(head.path) if head.method == b"POST" else None
        if reads is None:
            raise Refused(HTTPStatus.NOT_FOUND, f"POST to one of {', '.join(READS)}")
        count(len(data))
        wait_at_most(wire.socket, limits.body_s)
        if len(rest) < size and head.value("expect").lower() == "100-continue":
            wire.sendall(CONTINUE)
        try:
            body = _body(wire, rest, size, count)
        except BlockingIOError:
            message = f"nothing came of the body for {limits.body_s:g} s"
            raise Refused(HTTPStatus.REQUEST_TIMEOUT, message) from None
        exchange = FastExchange(wire, head, reads, body, limits)
        exchange.trace.mark("network")
        del body  # the exchange frees it once it is read
        exchange.held = held
        self._core.answer(exchange)
        return rest[size:] if exchange.keep else None

    def _head(self, wire: Wire, early: bytes) -> tuple[bytes, bytes]:
        """Return a head and the bytes after it; nothing if the client has closed, or sends none for an hour."""
        data, limits = bytearray(early), self._core.limits
        while (end := data.find(END)) < 0:
            if len(data) > limits.header_bytes:
                break
            wait_at_most(wire.socket, limits.head_s if data else native.KEEP_ALIVE_S)
            try:
                block = wire.socket.recv(PIECE)
            except BlockingIOError:
                if not data:
                    return b"", b""
                message = f"nothing came of the headers for {limits.head_s:g} s"
                raise Refused(HTTPStatus.REQUEST_TIMEOUT, message) from None
            if not block:
                return b"", b""
            data += block
        size = end + len(END)
        if end < 0 or size > limits.header_bytes:
            message = f"more than {limits.header_bytes} bytes of headers"
            raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, message)
        return bytes(data[:size]), bytes(data[size:])

    def _page(self, head: Head) -> bytes | None:
        """Return the answer of a page beside the chat, None for any other path."""
        if head.method == b"GET" and head.path == native.HEALTH:
            return native.json_answer(*native.health(self._core), keep=head.keep)
        if head.method == b"GET" and head.path == native.MODELS:
            return native.json_answer(200, native.models(self._core.queued), keep=head.keep)
        return None


def _body(wire: Wire, begun: bytes, size: int, count: Callable[[int], None]) -> memoryview:
    """Read a body into an array whose memory is touched only as bytes arrive. Raises EOFError, OSError."""
    body, have = np.empty(size, np.uint8).data, min(len(begun), size)
    body[:have] = begun[:have]
    count(have)
    while have < size:
        more = wire.socket.recv_into(body[have:])
        if not more:
            raise EOFError
        count(more)
        have += more
    return body


class FastExchange(ChatExchange):
    """A request with its body; a stream has chunked encoding, or for HTTP/1.0 ends with the connection."""

    def __init__(self, wire: Wire, head: Head, reads: Reads, body: memoryview, limits: Limits) -> None:
        super().__init__(native.FAST)
        self.takes_blocks = reads is of_picture
        self.keep = False
        """Whether the connection may be kept: set once the answer is sent."""
        self._wire, self._head, self._reads, self._body, self._limits = wire, head, reads, body, limits

    def disconnected(self) -> bool:
        return self._wire.disconnected()

    def read(self) -> tuple[Request, bool]:
        body, self._body = self._body, memoryview(b"")  # freed once it is decoded, before the wait for the engine
        return self._reads(self._head.headers, body, self.trace, self._limits)

    def write(self, data: bytes, kind: str, *, last: bool) -> None:
        if self._head.chunked:
            data = b"%x\r\n%b\r\n%b" % (len(data), data, b"0\r\n\r\n" if last else b"")
        if kind:
            headers = {"content-type": kind, **({"transfer-encoding": "chunked"} if self._head.chunked else {})}
            data = native.head_of(200, headers, keep=self._head.keep) + data
        self._wire.sendall(data)
        if last:
            self._over()

    def whole(self, status: int, value: Any, headers: dict[str, str]) -> None:
        self._wire.sendall(native.json_answer(status, value, headers, keep=self._head.keep))
        self._over()

    def _over(self) -> None:
        self._wire.flush(max(self.left_s(), LINGER_S))
        self.keep = self._head.keep
