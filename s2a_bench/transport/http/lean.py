"""The client of *best effort* and *binary*: the standard library's, by measurement the fastest there is.

`benchmarks/http_shootout.py` compares them (docs/measuring.md). A picture goes out of the array that holds it, nothing
is parsed that nobody needs, and no TLS context is built. It stands in for the part of an httpx client that `HttpClient`
uses, exceptions included, and keeps the same bounds.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPResponse, InvalidURL
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import httpx

from s2a_bench.transport.bounds import Bounds

PIECE = 1 << 16
"""Bytes of an answer that are read at once; a chunk may say that it is larger than any memory."""


class LeanResponse:
    """An answer whose headers are there."""

    def __init__(self, response: HTTPResponse) -> None:
        """Wrap what the standard library read."""
        self._response = response
        self.status_code, self.headers = response.status, response.headers

    def iter_raw(self) -> Iterator[bytes]:
        """Yield the body as it comes."""
        with _as_httpx():
            while piece := self._response.read1(PIECE):
                yield piece


class LeanClient:
    """One kept connection to one server, without TLS."""

    def __init__(self, bounds: Bounds, timeout_s: float) -> None:
        """Connect with the first request."""
        self.bounds = bounds
        self._timeout_s = timeout_s
        self._connection: _Connection | None = None

    @contextmanager
    def stream(self, method: str, url: str, *, content: Any, headers: Mapping[str, str]) -> Iterator[LeanResponse]:
        """Send a request; yield its answer, whose rest is thrown away, and the connection with it."""
        parts = urlsplit(url)
        if self._connection is None:
            self._connection = _Connection(parts.netloc, lambda: self.bounds, self._timeout_s)
        connection, response = self._connection, None
        try:
            with _as_httpx():
                if connection.sock is None:
                    connection.connect()
                with suppress(BrokenPipeError, ConnectionResetError):  # a refusal may be there already
                    connection.request(
                        method, urlunsplit(("", "", parts.path or "/", parts.query, "")), content, headers
                    )
                response = connection.getresponse()
            yield LeanResponse(response)
        finally:
            if response is None or not response.isclosed():
                connection.close()
            if response is not None:
                response.close()  # it may have taken the connection over

    def close(self) -> None:
        """Close the kept connection."""
        if self._connection is not None:
            self._connection.close()


class _Connection(HTTPConnection):
    """A connection over a bounded socket."""

    def __init__(self, netloc: str, bounds: Callable[[], Bounds], timeout_s: float) -> None:
        super().__init__(netloc)
        self._bounds, self._timeout_s = bounds, timeout_s

    def connect(self) -> None:
        try:
            timeout = min(self._timeout_s, self._bounds().left_s())
            plain = socket.create_connection((self.host, self.port), timeout)
        except TimeoutError as error:
            raise httpx.ConnectTimeout(str(error)) from error
        except OSError as error:
            raise httpx.ConnectError(str(error)) from error
        self.sock = _Socket(self._bounds, self._timeout_s, plain)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class _Socket(socket.socket):
    """A socket whose reads and writes end with the bounds."""

    def __init__(self, bounds: Callable[[], Bounds], timeout_s: float, plain: socket.socket) -> None:
        super().__init__(plain.family, plain.type, plain.proto, plain.detach())
        self._bounds, self._timeout_s = bounds, timeout_s

    def recv_into(self, *to: Any) -> int:
        """Read what is there, as `socket.makefile` does."""
        bounds = self._bounds()
        with self._in_time(bounds):
            size = super().recv_into(*to)
        bounds.came(size)
        return size

    def sendall(self, *data: Any) -> None:
        """Send the whole."""
        with self._in_time(self._bounds()):
            super().sendall(*data)

    @contextmanager
    def _in_time(self, bounds: Bounds) -> Iterator[None]:
        self.settimeout(min(self._timeout_s, bounds.left_s()))
        try:
            yield
        except TimeoutError:
            bounds.left_s()  # tells if it was the deadline
            raise


@contextmanager
def _as_httpx() -> Iterator[None]:
    """Raise what httpx would raise."""
    try:
        yield
    except InvalidURL as error:
        raise httpx.InvalidURL(str(error)) from error
    except TimeoutError as error:
        raise httpx.ReadTimeout(str(error)) from error
    except HTTPException as error:
        raise httpx.RemoteProtocolError(repr(error)) from error
    except OSError as error:
        raise httpx.ReadError(str(error)) from error
