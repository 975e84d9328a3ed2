"""The two HTTP clients, with bounds on everything that a server sends, headers and interim answers included.

httpx is the usual client; its time-outs hold for one read each, so that a byte a second, or ``103`` after ``103``,
never ends. *Best effort* and *binary* have the standard library's client, the fastest in our measurements
(docs/measuring.md): it sends a picture without a copy, parses only what is needed, and builds no TLS context. It has
the interface of httpx as far as `client` uses it, exceptions included.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPResponse, InvalidURL
from math import inf
from typing import Any, TypeAlias
from urllib.parse import urlsplit, urlunsplit

import httpcore
import httpx

from s2a_bench.transport.limits import Bounds

PIECE = 1 << 16
"""Bytes of an answer that are read at once; HTTP's announced lengths may exceed any memory."""


@contextmanager
def _in_time(bounds: Bounds, timeout_s: float | None) -> Iterator[float]:
    """Yield how long a read or write may take; raises RequestFailed if the deadline ended it."""
    try:
        yield min(inf if timeout_s is None else timeout_s, bounds.left_s())
    except (TimeoutError, httpcore.TimeoutException):
        bounds.left_s()
        raise


class BoundedClient(httpx.Client):
    def __init__(self, bounds: Bounds, **options: Any) -> None:
        # compression would delay tokens, and a few bytes could become gigabytes
        super().__init__(headers={"accept-encoding": "identity"}, **options)
        self.bounds = bounds
        # httpx has no option for httpcore's network backend, and a custom transport would not support proxies
        for transport in (self._transport, *self._mounts.values()):
            if isinstance(transport, httpx.HTTPTransport):
                pool = transport._pool  # noqa: SLF001
                pool._network_backend = _Network(pool._network_backend, self)  # noqa: SLF001


class _Network(httpcore.NetworkBackend):
    def __init__(self, backend: httpcore.NetworkBackend, client: BoundedClient) -> None:
        self._backend, self._client = backend, client

    def connect_tcp(
        self, host: str, port: int, timeout: float | None = None, *rest: Any, **options: Any
    ) -> httpcore.NetworkStream:
        with _in_time(self._client.bounds, timeout) as left_s:
            return _BoundedStream(self._backend.connect_tcp(host, port, left_s, *rest, **options), self._client)


class _BoundedStream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream, client: BoundedClient) -> None:
        self._stream, self._client = stream, client

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        with _in_time(self._client.bounds, timeout) as left_s:
            data = self._stream.read(max_bytes, left_s)
        self._client.bounds.count_bytes(len(data))
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        with _in_time(self._client.bounds, timeout) as left_s:
            self._stream.write(buffer, left_s)

    def start_tls(
        self, ssl_context: Any, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        with _in_time(self._client.bounds, timeout) as left_s:
            return _BoundedStream(self._stream.start_tls(ssl_context, server_hostname, left_s), self._client)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)

    def close(self) -> None:
        self._stream.close()


class LeanResponse:
    def __init__(self, response: HTTPResponse) -> None:
        self._response = response
        self.status_code, self.headers = response.status, response.headers

    def iter_raw(self) -> Iterator[bytes]:
        with _as_httpx():
            while piece := self._response.read1(PIECE):
                yield piece


class LeanClient:
    """One kept connection to one server, without TLS, opened by the first request."""

    def __init__(self, bounds: Bounds, timeout_s: float) -> None:
        self.bounds, self.timeout_s = bounds, timeout_s
        self._connection: HTTPConnection | None = None

    @contextmanager
    def stream(self, method: str, url: str, *, content: Any, headers: Mapping[str, str]) -> Iterator[LeanResponse]:
        """Send a request and yield its answer; the connection of an unfinished answer is closed."""
        target = urlsplit(url)
        response = None
        try:
            with _as_httpx():
                self._connection = connection = self._connection or HTTPConnection(target.netloc)
                if connection.sock is None:
                    connection.sock = self._connected(connection.host, connection.port)
                path = urlunsplit(("", "", target.path or "/", target.query, ""))
                with suppress(BrokenPipeError, ConnectionResetError):  # a refusal may have arrived already
                    connection.request(method, path, content, headers)
                response = connection.getresponse()
            yield LeanResponse(response)
        finally:
            if response is None or not response.isclosed():
                self.close()
            if response is not None:
                response.close()  # it may have taken the connection over

    def _connected(self, host: str, port: int) -> _Socket:
        try:
            plain = socket.create_connection((host, port), min(self.timeout_s, self.bounds.left_s()))
        except TimeoutError as error:
            raise httpx.ConnectTimeout(str(error)) from error
        except OSError as error:
            raise httpx.ConnectError(str(error)) from error
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return _Socket(self, plain)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()


class _Socket(socket.socket):
    """A socket whose reads and writes end with the bounds."""

    def __init__(self, client: LeanClient, plain: socket.socket) -> None:
        super().__init__(plain.family, plain.type, plain.proto, plain.detach())
        self._client = client

    def recv_into(self, *to: Any) -> int:
        with _in_time(self._client.bounds, self._client.timeout_s) as left_s:
            self.settimeout(left_s)
            size = super().recv_into(*to)
        self._client.bounds.count_bytes(size)
        return size

    def sendall(self, *data: Any) -> None:
        with _in_time(self._client.bounds, self._client.timeout_s) as left_s:
            self.settimeout(left_s)
            super().sendall(*data)


@contextmanager
def _as_httpx() -> Iterator[None]:
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


HttpResponse: TypeAlias = httpx.Response | LeanResponse
