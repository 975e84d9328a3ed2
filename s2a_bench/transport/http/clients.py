"""The two HTTP clients, bounded: whatever a server sends, headers and interim answers too, counts and takes time.

httpx is how servers are usually asked; its own time-outs are for one read each, so that a byte a second, or ``103``
after ``103``, never ends. *Best effort* and *binary* have the standard library's client, by measurement the fastest
there is (docs/measuring.md): a picture goes out of the array that holds it, nothing is parsed that nobody needs, and no
TLS context is built. It stands in for the part of an httpx client that is used here, exceptions included.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPResponse, InvalidURL
from math import inf
from typing import Any, TypeAlias
from urllib.parse import urlsplit, urlunsplit

import httpcore
import httpx

from s2a_bench.transport.limits import Bounds

PIECE = 1 << 16
"""Bytes of an answer that are read at once; a chunk may say that it is larger than any memory."""


@contextmanager
def _in_time(bounds: Bounds, timeout_s: float | None) -> Iterator[float]:
    """Yield how long a read or write may take; raises RequestFailed where it was the deadline that ended it."""
    try:
        yield min(inf if timeout_s is None else timeout_s, bounds.left_s())
    except (TimeoutError, httpcore.TimeoutException):
        bounds.left_s()
        raise


class BoundedClient(httpx.Client):
    """An httpx client that reads no more, and waits no longer, than the bounds of the request under way allow."""

    def __init__(self, bounds: Bounds, **options: Any) -> None:
        """Build the client; the options are httpx's."""
        # compression would delay tokens, and a few bytes could become gigabytes
        super().__init__(headers={"accept-encoding": "identity"}, **options)
        self.bounds = bounds
        # httpx has no option for httpcore's network backend, and a transport of our own would know no proxies
        for transport in (self._transport, *self._mounts.values()):
            if isinstance(transport, httpx.HTTPTransport):
                pool = transport._pool  # noqa: SLF001
                pool._network_backend = _Network(pool._network_backend, self)  # noqa: SLF001


class _Network(httpcore.NetworkBackend):
    """Opens bounded streams."""

    def __init__(self, backend: httpcore.NetworkBackend, client: BoundedClient) -> None:
        self._backend, self._client = backend, client

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        with _in_time(self._client.bounds, timeout) as left_s:
            stream = self._backend.connect_tcp(host, port, left_s, local_address, socket_options)
        return _BoundedStream(stream, self._client)


class _BoundedStream(httpcore.NetworkStream):
    """A connection whose reads and writes end with the bounds."""

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
        self.bounds, self.timeout_s = bounds, timeout_s
        self._connection: HTTPConnection | None = None

    @contextmanager
    def stream(self, method: str, url: str, *, content: Any, headers: Mapping[str, str]) -> Iterator[LeanResponse]:
        """Send a request; yield its answer, whose rest is thrown away, and the connection with it."""
        parts = urlsplit(url)
        response = None
        try:
            with _as_httpx():
                self._connection = connection = self._connection or HTTPConnection(parts.netloc)
                if connection.sock is None:
                    connection.sock = self._connected(connection.host, connection.port)
                path = urlunsplit(("", "", parts.path or "/", parts.query, ""))
                with suppress(BrokenPipeError, ConnectionResetError):  # a refusal may be there already
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
        """Read what is there, as `socket.makefile` does."""
        with _in_time(self._client.bounds, self._client.timeout_s) as left_s:
            self.settimeout(left_s)
            size = super().recv_into(*to)
        self._client.bounds.count_bytes(size)
        return size

    def sendall(self, *data: Any) -> None:
        """Send the whole."""
        with _in_time(self._client.bounds, self._client.timeout_s) as left_s:
            self.settimeout(left_s)
            super().sendall(*data)


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


HttpResponse: TypeAlias = httpx.Response | LeanResponse
