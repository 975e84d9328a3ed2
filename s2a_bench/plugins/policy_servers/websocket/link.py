"""The client's connection: websockets' threaded client, whose messages count and take time of one request."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread
from typing import Final

from websockets.exceptions import ConnectionClosed, InvalidStatus, PayloadTooBig, ProtocolError, WebSocketException
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.uri import parse_uri

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError, ServerDied, TransportError
from s2a_bench.plugins.policy_servers.websocket import codec
from s2a_bench.secrets import struck
from s2a_bench.transport.limits import Bounds

MESSAGE_BYTES: Final = 1 << 26
"""No answer is larger; the bounds of a request are tighter."""
QUEUED: Final = 4
"""Frames that are received before the request reads them; then reading rests."""
CLOSING_S: Final = 1.0
QUOTED: Final = 200
REFUSED: Final = "; refused: a wrong path or a key; see `url` and `api_key_env`"
"""The advice for 401 and 403; Starlette answers an unknown path with 403."""


class Broken(RequestFailed):
    """The server has closed the connection, orderly or not."""


class Connection:
    """A connection that fails in one line where more comes, or later, than the bounds of its request allow."""

    def __init__(
        self,
        url: str,
        headers: Mapping[str, str],
        bounds: Bounds,
        timeout_s: float,
        idle_s: float | None = None,
        compression: str | None = None,
    ) -> None:
        """Connect and shake hands; raises ServerDied, RequestFailed, TransportError.

        Empty messages keep the connection open if the server closes it after ``idle_s`` without a message. The client
        sends no pings: a server that is busy with a long answer may not answer them.
        """
        self._bounds = bounds
        self._url, self._timeout_s = url, timeout_s
        self._sent_ns, self._closed = now_ns(), Event()
        self._opened = ExitStack()
        plain = self._connected()
        with self._in_time() as seconds:
            opening = connect(
                url,
                sock=plain,
                additional_headers=headers,
                compression=compression,
                proxy=None,
                open_timeout=seconds,
                ping_interval=None,
                close_timeout=CLOSING_S,
                max_size=MESSAGE_BYTES,
                max_queue=QUEUED,
                logger=codec.QUIET,
            )
            self._connection = self._opened.enter_context(opening)
        if idle_s:
            Thread(target=self._keep_open, args=(idle_s / 3,), daemon=True).start()

    @property
    def compresses(self) -> bool:
        response = self._connection.response
        return response is not None and "Sec-WebSocket-Extensions" in response.headers

    def _connected(self) -> socket.socket:
        timeout_s = min(self._timeout_s, self._bounds.left_s())
        try:
            uri = parse_uri(self._url)
            return socket.create_connection((uri.host, uri.port), timeout_s)
        except (WebSocketException, ValueError) as error:
            raise TransportError(f"`url`: '{self._url}' is not the URL of a WebSocket: {error}") from error
        except OSError as error:
            why = f" within {timeout_s:g} s" if isinstance(error, TimeoutError) else f": {error}"
            raise ServerDied(f"nothing answers at {self._url}{why}") from error

    def _keep_open(self, third_s: float) -> None:
        """Send an empty message after each ``third_s`` without a message of ours."""
        with suppress(ConnectionClosed):
            while not self._closed.wait(third_s):
                if now_ns() - self._sent_ns >= third_s * 1e9:
                    self._connection.send(b"")

    def alive(self, bounds: Bounds) -> bool:
        """Whether the connection may be used again, within ``bounds``: it is open, and nothing came unasked."""
        self._bounds = bounds
        with suppress(TimeoutError, ConnectionClosed):
            self._connection.recv(0)
            return False
        return self._connection.state is State.OPEN

    def send(self, message: bytes) -> None:
        """Send a binary message, masked; raises Broken, RequestFailed."""
        with self._in_time() as seconds:
            self._connection.socket.settimeout(seconds)
            self._connection.send(message)
            self._sent_ns = now_ns()

    def receive(self) -> bytes | str:
        """Wait for one message, a text or bytes; raises Broken, RequestFailed."""
        with self._in_time() as seconds:
            message = self._connection.recv(seconds)
        self._bounds.count_bytes(len(message))
        return message

    @contextmanager
    def _in_time(self) -> Iterator[float]:
        try:
            yield min(self._timeout_s, self._bounds.left_s())
        except (OSError, ValueError, WebSocketException) as error:
            raise self._reason(error) from error

    def _reason(self, error: Exception) -> S2AError:
        """Return the error of an answer that did not come, from what websockets raised."""
        why = error if isinstance(error, OSError) else error.__cause__
        if isinstance(why, ssl.SSLError):
            return RequestFailed(f"{self._url}: no TLS: {why}")
        if isinstance(why, (ProtocolError, PayloadTooBig, UnicodeDecodeError)):
            return RequestFailed(f"{self._url} does not keep to the protocol: {str(why)[:QUOTED]}")
        if isinstance(why, TimeoutError):
            self._bounds.left_s()  # tells if it was the deadline
            return RequestFailed(f"{self._url} was silent for too long, {self._timeout_s:g} s", starting=True)
        if isinstance(error, InvalidStatus):
            response = error.response
            body = " ".join(struck(bytes(response.body or b"").decode(errors="replace"))[:QUOTED].split())
            advice = {401: "; see `api_key_env`", 403: REFUSED, 404: REFUSED}.get(response.status_code, "")
            line = f"{self._url} answered {response.status_code}: {body or 'nothing'}{advice}"
            return RequestFailed(line, starting=not advice)
        if isinstance(error, ConnectionClosed) or isinstance(why, (EOFError, OSError)):
            closed = error.rcvd if isinstance(error, ConnectionClosed) else None
            did = f"closed the connection: {closed}" if closed else f"broke the connection: {why or error}"
            return Broken(f"{self._url} {did[:QUOTED]}", starting=closed is None)
        return RequestFailed(f"{self._url} is not a WebSocket: {str(why or error)[:QUOTED]}")

    def close(self) -> None:
        """Close in order, for which the server has a second."""
        self._closed.set()
        self._opened.close()

    def abandon(self) -> None:
        """Close without a word."""
        with suppress(OSError):
            self._connection.socket.shutdown(socket.SHUT_RDWR)
        self.close()
