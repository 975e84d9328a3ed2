"""The client's connection: websockets' own, in which all that a server sends counts and takes time of one request."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any, Final

from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.extensions import ClientExtensionFactory
from websockets.frames import Frame
from websockets.protocol import State
from websockets.sync.client import ClientConnection
from websockets.uri import parse_uri

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError, ServerDied, TransportError
from s2a_bench.plugins.policy_servers.websocket import codec
from s2a_bench.secrets import struck
from s2a_bench.transport.limits import Bounds

MESSAGE_BYTES: Final = 1 << 26
"""No answer is larger; the bounds of a request are tighter."""
FRAME_BYTES: Final = 64
"""What a frame costs beside its data."""
CLOSING_S: Final = 1.0
QUOTED: Final = 200
REFUSED: Final = "; refused: a wrong path or a key; see `url` and `api_key_env`"
"""Of 403 too, with which Starlette answers an unknown path."""


class Broken(RequestFailed):
    """The server has closed the connection, orderly or not."""


class BoundedConnection(ClientConnection):
    """A connection that ends where more comes than the bounds of its request allow."""

    def __init__(
        self,
        url: str,
        headers: Mapping[str, str],
        bounds: Bounds,
        timeout_s: float,
        idle_s: float | None = None,
        extensions: Sequence[ClientExtensionFactory] | None = None,
    ) -> None:
        """Connect and shake hands; raises ServerDied, RequestFailed, TransportError.

        Empty messages keep the connection open if the server closes it after ``idle_s`` without a message.
        """
        self.bounds = bounds
        self._url, self._timeout_s = url, timeout_s
        self._sent_ns, self._closed = now_ns(), Event()
        try:
            uri = parse_uri(url)
        except (InvalidURI, ValueError) as error:
            raise TransportError(f"`url`: '{url}' is no URL of a WebSocket: {error}") from error
        plain = self._connected(uri.host, uri.port, secure=uri.secure)
        protocol = ClientProtocol(uri, extensions=extensions, max_size=MESSAGE_BYTES, logger=codec.QUIET)
        super().__init__(plain, protocol, ping_interval=None, close_timeout=CLOSING_S)
        self.__enter__()
        try:
            with self._in_time() as seconds:
                self.handshake(headers, timeout=seconds)
        except BaseException:
            self.close_socket()
            raise
        if idle_s:
            Thread(target=self._keep_open, args=(idle_s / 3,), daemon=True).start()

    def process_event(self, event: Any) -> None:
        if isinstance(event, Frame):
            self.bounds.count_bytes(len(event.data) + FRAME_BYTES)
        super().process_event(event)

    def _keep_open(self, third_s: float) -> None:
        """Send an empty message after each ``third_s`` without a message of ours."""
        with suppress(OSError, ConnectionClosed):
            while not self._closed.wait(third_s):
                if now_ns() - self._sent_ns >= third_s * 1e9:
                    self.send(b"")

    def _connected(self, host: str, port: int, *, secure: bool) -> socket.socket:
        timeout_s = min(self._timeout_s, self.bounds.left_s())
        try:
            plain = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            why = f" within {timeout_s:g} s" if isinstance(error, TimeoutError) else f": {error}"
            raise ServerDied(f"nothing answers at {self._url}{why}") from error
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not secure:
            return plain
        try:
            return ssl.create_default_context().wrap_socket(plain, server_hostname=host)
        except (OSError, ValueError) as error:
            plain.close()
            raise RequestFailed(f"{self._url}: no TLS: {error}") from error

    def alive(self, bounds: Bounds) -> bool:
        """Whether the connection may be used again, within ``bounds``: it is open, and nothing came unasked."""
        self.bounds = bounds
        with suppress(TimeoutError, ConnectionClosed):
            self.recv(0)
            return False
        return self.state is State.OPEN

    def send_in_time(self, message: bytes) -> None:
        """Send a binary message, masked; raises Broken, RequestFailed."""
        with self._in_time() as seconds:
            self.socket.settimeout(seconds)
            self.send(message)
            self._sent_ns = now_ns()

    def receive(self) -> bytes | str:
        """Wait for one message, a text or bytes; raises Broken, RequestFailed."""
        with self._in_time() as seconds:
            return self.recv(seconds)

    @contextmanager
    def _in_time(self) -> Iterator[float]:
        try:
            yield min(self._timeout_s, self.bounds.left_s())
        except (OSError, ConnectionClosed, InvalidHandshake) as error:
            raise self._reason(error) from error

    def _reason(self, error: Exception) -> S2AError:
        """Return the error of an answer that did not come, from what websockets raised."""
        why = error if isinstance(error, OSError) else error.__cause__
        if isinstance(why, S2AError):
            return why
        breach = self.protocol.parser_exc
        if breach is not None and not isinstance(breach, EOFError):
            return RequestFailed(f"{self._url} does not keep to the protocol: {str(breach)[:QUOTED]}")
        if isinstance(why, TimeoutError):
            self.bounds.left_s()  # tells if it was the deadline
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
        return RequestFailed(f"{self._url} is no WebSocket: {str(why or error)[:QUOTED]}")

    def close_socket(self) -> None:
        """Close without a word, which `close` sends, and for which the server has a second."""
        self._closed.set()
        super().close_socket()
