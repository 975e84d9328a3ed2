"""The client's connection: websockets' protocol without its threads, on one blocking socket with bounds.

websockets' own client waits with a thread of its own and bounds single reads. Here all that a server sends counts and
takes time of one request, and it is as fast (docs/measuring.md). Messages are never compressed.
"""

from __future__ import annotations

import logging
import socket
import ssl
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from select import POLLIN, poll

from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.frames import Frame, Opcode
from websockets.protocol import SEND_EOF, State
from websockets.uri import parse_uri

from s2a_bench.errors import RequestFailed, ServerDied, TransportError
from s2a_bench.secrets import struck
from s2a_bench.transport.bounds import Bounds

PIECE = 1 << 18
"""Bytes that are read at once."""
MESSAGE_BYTES = 1 << 26
"""No answer is larger; the bounds of a request are tighter."""
QUOTED = 200
DATA = frozenset({Opcode.TEXT, Opcode.BINARY, Opcode.CONT})
QUIET = logging.getLogger("s2a_bench.websocket")
QUIET.addHandler(logging.NullHandler())
QUIET.propagate = False


class Broken(RequestFailed):
    """The server has closed the connection, orderly or not."""


class Link:
    """One connection to one server."""

    def __init__(self, url: str, headers: Mapping[str, str], bounds: Bounds, timeout_s: float) -> None:
        """Connect and shake hands; raises ServerDied, RequestFailed, TransportError."""
        self.bounds = bounds
        self._url, self._timeout_s = url, timeout_s
        self._ready: deque[Frame] = deque()
        self._message = bytearray()
        self._text = False
        try:
            uri = parse_uri(url)
            self._protocol = ClientProtocol(uri, max_size=MESSAGE_BYTES, logger=QUIET)
            request = self._protocol.connect()
        except (InvalidURI, ValueError) as error:
            raise TransportError(f"`url`: '{url}' is no URL of a WebSocket: {error}") from error
        request.headers.update(headers)
        self._protocol.send_request(request)
        self._socket = self._connected(uri.host, uri.port, secure=uri.secure)
        try:
            self._flush()
            while self._protocol.state is State.CONNECTING:
                self._read()
                if self._protocol.handshake_exc is not None:
                    raise self._refused(self._protocol.handshake_exc)
        except BaseException:
            self.close()
            raise

    def _connected(self, host: str, port: int, *, secure: bool) -> socket.socket:
        timeout_s = min(self._timeout_s, self.bounds.left_s())
        try:
            plain = socket.create_connection((host, port), timeout_s)
        except TimeoutError as error:
            raise ServerDied(f"nothing answers at {self._url} within {timeout_s:g} s") from error
        except OSError as error:
            raise ServerDied(f"nothing answers at {self._url}: {error}") from error
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not secure:
            return plain
        try:
            return ssl.create_default_context().wrap_socket(plain, server_hostname=host)
        except (OSError, ValueError) as error:
            plain.close()
            raise RequestFailed(f"{self._url}: no TLS: {error}") from error

    def alive(self) -> bool:
        """Whether the connection may be used again: nothing came unasked but pings, which are answered."""
        with suppress(RequestFailed):
            while self._pending():
                self._read()
        stray = any(frame.opcode in DATA for frame in self._frames())
        return self._protocol.state is State.OPEN and not (self._message or stray)

    def _pending(self) -> bool:
        if self._protocol.state is not State.OPEN:
            return False
        waiting = poll()
        waiting.register(self._socket, POLLIN)
        return bool(waiting.poll(0))

    def pack(self, data: bytes) -> list[bytes]:
        """Return a binary message as it goes over the wire, masked; raises Broken."""
        self._require_open()
        self._protocol.send_binary(data)
        return self._protocol.data_to_send()

    def send(self, pieces: list[bytes]) -> None:
        """Send what `pack` returned."""
        with self._in_time():
            for piece in pieces:
                self._socket.sendall(piece)

    def receive(self) -> bytes | str:
        """Wait for one message, a text or bytes; raises Broken, RequestFailed."""
        while True:
            for frame in self._frames():
                if (message := self._joined(frame)) is not None:
                    return message
            self._require_open()
            self._read()

    def _frames(self) -> Iterator[Frame]:
        """Take the frames that are there, one at a time: what follows a message stays for the next."""
        self._ready.extend(event for event in self._protocol.events_received() if isinstance(event, Frame))
        while self._ready:
            yield self._ready.popleft()

    def _joined(self, frame: Frame) -> bytes | str | None:
        """Add a frame to the message; return it when it is whole."""
        if frame.opcode not in DATA:
            return None
        if frame.opcode is not Opcode.CONT:
            self._text = frame.opcode is Opcode.TEXT
            if frame.fin:
                return self._whole(frame.data)
        self._message += frame.data
        if not frame.fin:
            return None
        data, self._message = self._message, bytearray()
        return self._whole(data)

    def _whole(self, data: bytes | bytearray | memoryview) -> bytes | str:
        return bytes(data).decode(errors="replace") if self._text else bytes(data)

    def _require_open(self) -> None:
        if self._protocol.state is State.OPEN:
            return
        if self._protocol.state is State.CLOSED:
            said: ConnectionClosed | str = self._protocol.close_exc
        else:
            said = f"it is {self._protocol.state.name.lower()}"
        if (wrong := self._protocol.parser_exc) is not None and not isinstance(wrong, EOFError):
            raise RequestFailed(f"{self._url} does not keep to the protocol: {wrong}")
        closed = self._protocol.close_rcvd
        if closed is not None:
            raise Broken(f"{self._url} closed the connection: {str(closed)[:QUOTED]}")
        raise Broken(f"{self._url} broke the connection: {said}")

    def _read(self) -> None:
        """Read what is there, wait for it if need be, and answer what wants an answer."""
        with self._in_time():
            data = self._socket.recv(PIECE)
        if data:
            self.bounds.came(len(data))
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._flush()

    def _flush(self) -> None:
        """Send what the protocol has to say; half a connection that is closed is no matter."""
        with self._in_time():
            for piece in self._protocol.data_to_send():
                if piece != SEND_EOF:
                    self._socket.sendall(piece)

    @contextmanager
    def _in_time(self) -> Iterator[None]:
        """Bound what the socket does, and name what goes wrong."""
        self._socket.settimeout(min(self._timeout_s, self.bounds.left_s()))
        try:
            yield
        except TimeoutError as error:
            self.bounds.left_s()  # tells if it was the deadline
            raise RequestFailed(f"{self._url} was silent for too long, {self._timeout_s:g} s") from error
        except OSError as error:
            raise Broken(f"{self._url} broke the connection: {error}") from error

    def _refused(self, error: Exception) -> TransportError:
        """Say why the handshake failed."""
        if isinstance(error, InvalidStatus):
            response = error.response
            said = " ".join(struck(bytes(response.body or b"").decode(errors="replace"))[:QUOTED].split())
            advice = "; see `api_key_env`" if response.status_code in {401, 403} else ""
            return RequestFailed(f"{self._url} answered {response.status_code}: {said or 'nothing'}{advice}")
        if isinstance(error, InvalidHandshake):
            cause = error.__cause__ or error
            if isinstance(cause, EOFError):
                return Broken(f"{self._url} closed the connection before the handshake was over")
            return RequestFailed(f"{self._url} is no WebSocket: {str(cause)[:QUOTED]}")
        return RequestFailed(f"{self._url}: no handshake: {error}")

    def close(self) -> None:
        """Say that it is over, and close without waiting; may be called twice."""
        with suppress(OSError):
            if self._protocol.state is State.OPEN:
                self._protocol.send_close(1000)
                self._socket.settimeout(0)
                self._socket.send(b"".join(self._protocol.data_to_send()))
        self._socket.close()
