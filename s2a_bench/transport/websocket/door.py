"""One connection to our policy server, on the event loop: websockets' protocol, with every limit kept before it costs.

The loop never waits for anybody: it shakes hands, counts and joins what comes, answers pings and `/healthz`, and hands
each whole message to a call on a thread, which writes its answer to the socket itself. What the socket does not take at
once goes through the loop, in order. One request runs at a time; one more may come meanwhile, then reading rests.
"""

from __future__ import annotations

import asyncio
import socket
from asyncio import AbstractEventLoop, TimerHandle, Transport
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Final, cast

from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.protocol import SEND_EOF, State
from websockets.server import ServerProtocol

from s2a_bench.clock import now_ns
from s2a_bench.machine.tuning import give_back_memory
from s2a_bench.trace import Trace
from s2a_bench.transport.credentials import has_key
from s2a_bench.transport.turns import STUCK_S
from s2a_bench.transport.websocket import STREAM_PATH, own
from s2a_bench.transport.websocket.call import Call, Office
from s2a_bench.transport.websocket.link import QUIET
from s2a_bench.transport.websocket.outlet import Outlet

LINGER_S: Final = 1.0
"""Time for a client to read a refusal, or to answer that the connection closes."""
LARGE_BYTES: Final = 1 << 25
"""Memory of a message from here on goes back to the system."""
ERROR_LETTERS: Final = 1000
CONTROL_BYTES: Final = 256
END_OF_HEAD: Final = b"\r\n\r\n"


class House:
    """What all connections of a server share."""

    def __init__(self, office: Office, key: str, metadata: bytes) -> None:
        """Let in who has the ``key``, and greet with ``metadata``."""
        self.office, self.key, self.metadata = office, key.encode(), metadata
        self.doors: set[Door] = set()
        self.held = 0
        """Bytes of requests that are coming, or not answered yet."""


class Door(asyncio.Protocol):
    """One connection."""

    def __init__(self, house: House, loop: AbstractEventLoop) -> None:
        """Wait for a client."""
        self.ours = self.streams = False
        self.previous_ms: float | None = None
        self._house, self._loop, self._limits = house, loop, house.office.limits
        # a browser says where its page is from, and no page may drive a robot (RFC 6455, 10.2)
        self._protocol = ServerProtocol(origins=[None], max_size=self._limits.body_bytes, logger=QUIET)
        self._message = bytearray()
        self._head = bytearray()
        self._held = 0
        self._call: Call | None = None
        self._call_bytes = 0
        self._next: tuple[bytes, int] | None = None
        self._timer: TimerHandle | None = None
        self._full = self._paused = self._over = False

    # the loop's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Give the client its time to shake hands; refuse one connection too many."""
        self._transport = cast("Transport", transport)
        plain = self._transport.get_extra_info("socket")
        with suppress(OSError):
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._out = Outlet(self._transport, self._loop)
        self._house.doors.add(self)
        self._full = len(self._house.doors) > self._limits.connections
        late = partial(self._reject, HTTPStatus.REQUEST_TIMEOUT, "the handshake took too long")
        self._in_time(LINGER_S if self._full else self._limits.head_s, late)

    def data_received(self, data: bytes) -> None:
        """Take what comes: the handshake, then frames."""
        came_ns = now_ns()
        if self._over:
            self._agree(data)
            return
        if self._full:
            self._reject(HTTPStatus.SERVICE_UNAVAILABLE, f"{self._limits.connections} connections are open already")
            return
        if self._protocol.state is State.CONNECTING:
            self._head += data
            end = self._head.find(END_OF_HEAD) + len(END_OF_HEAD)
            if end < len(END_OF_HEAD) or end > self._limits.header_bytes:
                if len(self._head) > self._limits.header_bytes:
                    self._reject(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "the headers are too long")
                return
            # what follows is not looked at before it is known that there may be frames
            data, head, self._head = bytes(self._head[end:]), bytes(self._head[:end]), bytearray()
            self._feed(head, came_ns)
        if data and not self._over:
            self._feed(data, came_ns)

    def _feed(self, data: bytes, came_ns: int) -> None:
        """Have bytes read as what the protocol expects now."""
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, Handshake):
                self._shake_hands(event)
            elif isinstance(event, Frame) and not self._over:
                self._framed(event, came_ns)
        if not self._flush() and self._protocol.handshake_exc is not None:
            self._reject(HTTPStatus.BAD_REQUEST, f"no handshake: {self._protocol.handshake_exc}")
        self._count()

    def eof_received(self) -> bool:
        """Close too."""
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        """Give back what the connection held."""
        del exc
        self._over = True
        self._stop_timer()
        if self._call is not None:
            self._call.leave()
        self._house.doors.discard(self)
        self._message.clear()
        self._protocol.reader.discard()
        self._hold(0)
        if self._call is None:
            self._out.close()

    def pause_writing(self) -> None:
        """Take no more requests of a client that does not read its answers."""
        self._paused = True
        self._reads(False)

    def resume_writing(self) -> None:
        """Go on."""
        self._paused = False
        self._read_on()

    @property
    def busy(self) -> bool:
        """Whether a request is under way."""
        return self._call is not None

    def hang_up(self) -> None:
        """End the connection, as the server does."""
        self._close(CloseCode.GOING_AWAY, "the server stops")
        self._transport.close()

    def _shake_hands(self, request: Handshake) -> None:
        """Answer the handshake, and greet."""
        protocol = self._protocol
        path = request.path.partition("?")[0]
        said = request.headers.get_all("Authorization")
        if path == own.HEALTH:
            silent_s = self._house.office.queued.turns.silent_s()
            stuck = f"the answer under way has shown no sign of life for {silent_s:.0f} s\n"
            well = silent_s <= STUCK_S
            response = protocol.reject(
                HTTPStatus.OK if well else HTTPStatus.SERVICE_UNAVAILABLE, "OK\n" if well else stuck
            )
        elif self._house.key and not (len(said) == 1 and has_key(said[0].encode(), own.SCHEME, self._house.key)):
            words = f"this server wants its key: Authorization: {own.SCHEME} KEY\n"
            response = protocol.reject(HTTPStatus.UNAUTHORIZED, words)
            response.headers["WWW-Authenticate"] = own.SCHEME
        else:
            response = protocol.accept(request)
        protocol.send_response(response)
        self._stop_timer()
        if protocol.state is State.OPEN:
            self.ours = own.MARKS_HEADER in request.headers
            self.streams = path.rstrip("/").endswith(STREAM_PATH)
            protocol.send_binary(self._house.metadata)

    def _framed(self, frame: Frame, came_ns: int) -> None:
        """Join what belongs to a message, and have a whole one answered."""
        if frame.opcode is Opcode.TEXT:
            self._refuse("an observation is a binary message, not a text", CloseCode.UNSUPPORTED_DATA)
        elif frame.opcode is Opcode.BINARY and frame.fin:
            self._asked(cast("bytes", frame.data), came_ns)
        elif frame.opcode in {Opcode.BINARY, Opcode.CONT}:
            self._message += frame.data
            if frame.fin:
                message, self._message = self._message, bytearray()
                self._asked(bytes(message), came_ns)

    def _asked(self, message: bytes, came_ns: int) -> None:
        """Answer a message, when the one before is answered."""
        if self._house.held - self._held + self._call_bytes + len(message) > self._limits.in_flight_bytes:
            self._refuse_for_now()
        elif self._next is not None:
            self._refuse("more than two requests at once", CloseCode.POLICY_VIOLATION)
        elif self._call is not None:
            self._next = message, came_ns
            self._reads(False)
        else:
            trace = Trace()
            trace.marks.append(("network", came_ns))
            trace.mark("frame_parse")
            self._call_bytes = len(message)
            self._call = Call(self._house.office, self._loop, self)
            self._call.start(message, trace)

    def _count(self) -> None:
        """Count what is held, and how long a message takes to come."""
        coming = len(self._protocol.reader.buffer) + len(self._message)
        if not self._over and self._protocol.state is State.OPEN:
            if not coming:
                self._stop_timer()
            elif self._timer is None and self._next is None:
                late = f"a message took more than {self._limits.body_s:g} s"
                self._in_time(self._limits.body_s, partial(self._refuse, late, CloseCode.POLICY_VIOLATION))
        self._hold(coming + self._call_bytes + (len(self._next[0]) if self._next else 0))
        if coming and self._house.held > self._limits.in_flight_bytes:
            self._refuse_for_now()

    def _hold(self, size: int) -> None:
        self._house.held += size - self._held
        self._held = size

    def _read_on(self) -> None:
        if self._next is None and not self._paused and not self._over:
            self._reads(True)

    def _reads(self, reads: bool) -> None:
        with suppress(RuntimeError):  # it is closing
            (self._transport.resume_reading if reads else self._transport.pause_reading)()

    def _over_call(self, error: str) -> None:
        """Take the next request; after an error close, as openpi's server does."""
        size, self._call, self._call_bytes = self._call_bytes, None, 0
        if size >= LARGE_BYTES:
            self._loop.call_later(LINGER_S, give_back_memory)
        if self not in self._house.doors:
            self._out.close()
        elif self._over:
            self._hold(0)
        elif error:
            self._refuse(error, CloseCode.INTERNAL_ERROR)
        else:
            if self._next is not None:
                (message, came_ns), self._next = self._next, None
                self._asked(message, came_ns)
            self._read_on()
            self._count()

    def _refuse_for_now(self) -> None:
        words = f"requests of {self._limits.in_flight_bytes} bytes are under way already; come again later"
        self._refuse(words, CloseCode.TRY_AGAIN_LATER)

    def _refuse(self, words: str, code: CloseCode) -> None:
        """Say what is wrong in a text, and close."""
        if self._over:
            return
        if self._protocol.state is State.OPEN:
            if not self._protocol.expect_continuation_frame:
                self._protocol.send_text(words[:ERROR_LETTERS].encode(errors="backslashreplace"))
            self._close(code, "see the text before")
        self._end()

    def _close(self, code: CloseCode, reason: str) -> None:
        self._stop_timer()
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code, reason)
        self._flush()

    def _reject(self, status: HTTPStatus, words: str) -> None:
        """Refuse what is no handshake, or comes at a bad time."""
        if self._over:
            return
        body = f"{words}\n".encode(errors="backslashreplace")
        head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        self._out.send(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
        self._end()

    def _end(self, linger_s: float = LINGER_S) -> None:
        """Throw away what still comes, and close soon: closing at once would reset what the client has not read."""
        if self._over:
            return
        self._over = True
        self._stop_timer()
        if self._call is not None:
            self._call.leave()
        self._next = None
        self._message.clear()
        self._protocol.reader.discard()
        self._hold(self._call_bytes)
        self._reads(True)
        self._loop.call_later(linger_s, self._transport.close)

    def _agree(self, data: bytes) -> None:
        """Close at once where the client answers that the connection closes; all else is thrown away."""
        protocol = self._protocol
        waits = protocol.close_sent is not None and protocol.close_rcvd is None
        if waits and len(data) <= CONTROL_BYTES:
            protocol.receive_data(data)
            protocol.events_received()
            if protocol.close_rcvd is not None:
                self._transport.close()

    def _flush(self) -> bool:
        """Send what the protocol has to say; return whether it had anything."""
        told = self._protocol.data_to_send()
        pieces = [piece for piece in told if piece != SEND_EOF]
        for piece in pieces:
            self._out.send(piece)
        if len(pieces) < len(told) and (pieces or self._protocol.state is not State.CONNECTING):
            agreed = self._protocol.close_rcvd is not None and self._protocol.close_sent is not None
            self._end(0 if agreed else LINGER_S)
        return bool(pieces)

    def _in_time(self, seconds: float, late: Callable[[], None]) -> None:
        self._stop_timer()
        self._timer = self._loop.call_later(seconds, late)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    # any thread's side

    def write(self, message: bytes | str) -> None:
        """Send a message to the client."""
        if self._over:
            return
        opcode = Opcode.TEXT if isinstance(message, str) else Opcode.BINARY
        data = message.encode() if isinstance(message, str) else message
        self._out.send(Frame(opcode, data).serialize(mask=False))

    def answered(self, error: str) -> None:
        """Let the loop go on with the next request, or close after an error."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._over_call, error)
