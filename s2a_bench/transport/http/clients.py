"""The two HTTP clients, and the bounds on the body that a server sends.

httpx is the usual client. *Best effort* and *binary* have the standard library's client, the fastest in our
measurements (docs/measuring.md): it sends a picture without a copy, parses only what is needed, and builds no TLS
context. It has the interface of httpx as far as `client` uses it, exceptions included. Both bound a head themselves;
the time-out holds for one read, and `pieces` checks the deadline after each piece of a body.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPResponse, InvalidURL
from typing import Any, TypeAlias
from urllib.parse import urlsplit, urlunsplit

import httpx

from s2a_bench.transport.limits import Bounds

PIECE = 1 << 16
"""Bytes of an answer that are read at once; HTTP's announced lengths may exceed any memory."""


def usual_client(url: str, timeout_s: float) -> httpx.Client:
    """Return httpx's client, which keeps its connections however long a turn of the other cells takes.

    Only a cloud's server may need the proxy and the certificates of the environment. Compression would delay tokens,
    and a few bytes could become gigabytes.
    """
    return httpx.Client(
        headers={"accept-encoding": "identity"},
        timeout=timeout_s,
        trust_env=url.startswith("https:"),
        limits=httpx.Limits(keepalive_expiry=None),
    )


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

    def __init__(self) -> None:
        self._connection: HTTPConnection | None = None

    @contextmanager
    def stream(
        self, method: str, url: str, *, content: Any, headers: Mapping[str, str], timeout: float
    ) -> Iterator[LeanResponse]:
        """Send a request and yield its answer; the connection of an unfinished answer is closed."""
        target = urlsplit(url)
        response = None
        try:
            connection = self._connected(target.netloc, timeout)
            with _as_httpx():
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

    def _connected(self, netloc: str, timeout: float) -> HTTPConnection:
        if self._connection is not None and self._connection.sock is not None:
            self._connection.sock.settimeout(timeout)
            return self._connection
        try:
            self._connection = HTTPConnection(netloc, timeout=timeout)
            self._connection.connect()
        except InvalidURL as error:
            raise httpx.InvalidURL(str(error)) from error
        except TimeoutError as error:
            raise httpx.ConnectTimeout(str(error)) from error
        except OSError as error:
            raise httpx.ConnectError(str(error)) from error
        return self._connection

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()


@contextmanager
def _as_httpx() -> Iterator[None]:
    try:
        yield
    except InvalidURL as error:  # of a path
        raise httpx.InvalidURL(str(error)) from error
    except TimeoutError as error:
        raise httpx.ReadTimeout(str(error)) from error
    except HTTPException as error:
        raise httpx.RemoteProtocolError(repr(error)) from error
    except OSError as error:
        raise httpx.ReadError(str(error)) from error


HttpResponse: TypeAlias = httpx.Response | LeanResponse


def pieces(response: HttpResponse, bounds: Bounds) -> Iterator[bytes]:
    """Yield an answer's body as it arrives; raises RequestFailed beyond its bounds."""
    for data in response.iter_raw():
        bounds.count_bytes(len(data))
        bounds.left_s()
        yield data
