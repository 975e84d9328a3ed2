"""Our policy server: openpi's protocol, which reports health and answers pings whatever the engine does.

A connection is websockets' protocol without its I/O, on a thread that reads with deadlines. A second thread answers, so
that pings are answered meanwhile; what it sends never waits for the client while the engine is held. One request runs
at a time and one more may wait here; then reading rests. websockets' own threaded server takes four descriptors a
connection where this takes one, and cannot end a message that does not come.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from http import HTTPStatus
from queue import Queue
from threading import RLock, Thread
from typing import Any, Final, cast

import numpy as np
import websockets.version
from websockets.exceptions import InvalidState
from websockets.frames import DATA_OPCODES, CloseCode, Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.http11 import Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, S2AError, TooLarge
from s2a_bench.facts import INFER_MS
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.websocket import PREV_TOTAL_MS, STREAM_PATH, WebsocketOptions, codec
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import Access, WebServer
from s2a_bench.transport.connections import LINGER_S, Connections, Wire
from s2a_bench.transport.serving import Core, Disconnected, Queued
from s2a_bench.types import Piece, Request

PIECE: Final = 1 << 16
"""Bytes that are read at once."""
ERROR_LETTERS: Final = 1000
END_OF_HEAD: Final = b"\r\n\r\n"


class WebsocketServer(WebServer):
    def __init__(self, wiring: Wiring[WebsocketOptions], handler: Handler) -> None:
        super().__init__(wiring, handler, "ws", codec.SCHEME)
        self._listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, 1)  # a full server answers with a status
        self._metadata = packb(metadata_of(self._core.queued))
        most = wiring.limits.connections
        full = ServerProtocol().reject(HTTPStatus.SERVICE_UNAVAILABLE, f"{most} connections are open already\n")
        connections = Connections(self._listener, self._handle, most, full.serialize())
        self.serve, self.stop = connections.serve, connections.stop

    def describe(self) -> dict[str, str | int]:
        return {"server": "websockets", "version": websockets.version.version}

    def _handle(self, wire: Wire) -> None:
        PolicyConnection(wire, self._core, self._access, self._metadata).serve()


class _Refused(Exception):
    """The connection ends with a status or a close code, and a line."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


class PolicyConnection:
    """One client. The thread of its connection calls `serve`, the other one what an exchange needs."""

    def __init__(self, wire: Wire, core: Core, access: Access, metadata: bytes) -> None:
        self.wire, self.core = wire, core
        self.native = self.streams = False
        """Whether it is our client, which receives our marks; whether actions are sent one by one."""
        self.previous_ms: float | None = None
        """What the request before took."""
        self._access, self._metadata = access, metadata
        self._protocol = ServerProtocol(max_size=core.limits.body_bytes, logger=codec.QUIET)
        self._lock = RLock()  # of the protocol, and of what is sent
        self._message = bytearray()
        self._timed = False
        self._requests: Queue[WebsocketExchange | None] = Queue(1)
        self._held = ExitStack()
        self._count()

    def serve(self) -> None:
        plain = self.wire.socket
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        answering = Thread(target=self._answer_all, name="answers", daemon=True)
        with self._held:
            try:
                head, rest = self._head()
                response = self._response(head, answering)
            except _Refused as error:
                response = self._protocol.reject(error.code, f"{error}\n")
            if response.status_code != HTTPStatus.SWITCHING_PROTOCOLS:
                self.wire.sendall(response.serialize())
                self.wire.linger()
                return
            self._protocol.send_response(response)
            try:
                self.send(self._metadata)
                self._read_all(rest)
            finally:
                self._requests.put(None)
                answering.join()
            with self._lock, suppress(InvalidState):
                self._protocol.send_close(CloseCode.GOING_AWAY, "the server stops")
                self._flush()

    def _head(self) -> tuple[bytes, bytes]:
        """Read the handshake; return it, and what came behind it."""
        limits, head, end = self.core.limits, bytearray(), -1
        self.wire.read_until(now_ns() + round(limits.head_s * 1e9))
        while end < 0:
            data = self._received()
            if not data:
                raise EOFError
            head += data
            end = head.find(END_OF_HEAD)
            if (len(head) if end < 0 else end) > limits.header_bytes:
                raise _Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "the headers are too long")
        end += len(END_OF_HEAD)
        return bytes(head[:end]), bytes(head[end:])

    def _response(self, head: bytes, answering: Thread) -> Response:
        """Return the answer to a handshake; start the thread ``answering`` where it is accepted."""
        protocol = self._protocol
        protocol.receive_data(head)
        requests = protocol.events_received()
        if not requests:
            raise _Refused(HTTPStatus.BAD_REQUEST, f"no handshake: {protocol.handshake_exc}")
        request = cast("Handshake", requests[0])
        path = request.path.partition("?")[0]
        headers = ((name.lower(), value) for name, value in request.headers.raw_items())
        refused = self._access.refusal(path == codec.HEALTH, headers)
        if refused is not None:
            response = protocol.reject(refused[0], f"{refused[1]}\n")
            if refused[0] == HTTPStatus.UNAUTHORIZED:
                response.headers["WWW-Authenticate"] = codec.SCHEME
            return response
        if path == codec.HEALTH:
            stuck = self.core.stuck()
            return protocol.reject(HTTPStatus.SERVICE_UNAVAILABLE if stuck else HTTPStatus.OK, f"{stuck or 'OK'}\n")
        self.native = codec.MARKS_HEADER in request.headers
        self.streams = path.rstrip("/").endswith(STREAM_PATH)
        response = protocol.accept(request)
        if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
            try:
                answering.start()
            except RuntimeError as error:
                raise _Refused(HTTPStatus.SERVICE_UNAVAILABLE, f"{error} for this connection") from error
        return response

    def _read_all(self, data: bytes) -> None:
        """Read messages until the connection closes; an answer under way is then abandoned."""
        try:
            self._take(data)
            while self._open and (data := self._received()):
                self._take(data)
        except _Refused as error:
            self._message.clear()
            self._protocol.reader.discard()
            self._held.close()
            self._refuse(error.code, str(error))
        if not self._open:
            self.wire.linger()
            self.wire.hang_up()

    def _received(self) -> bytes:
        """Return what came, none at the end."""
        shaking, limits = self._protocol.state is State.CONNECTING, self.core.limits
        try:
            data = self.wire.recv(PIECE)
            self._came(len(data))
        except TimeoutError as error:
            late = HTTPStatus.REQUEST_TIMEOUT if shaking else CloseCode.POLICY_VIOLATION
            what, limit_s = ("the handshake", limits.head_s) if shaking else ("a message", limits.body_s)
            raise _Refused(late, f"{what} took more than {limit_s:g} s") from error
        except Busy as error:
            busy = HTTPStatus.SERVICE_UNAVAILABLE if shaking else CloseCode.TRY_AGAIN_LATER
            raise _Refused(busy, f"{error}; come again later") from error
        except TooLarge as error:
            raise _Refused(CloseCode.MESSAGE_TOO_BIG, str(error)) from error
        return data

    def _take(self, data: bytes) -> None:
        with self._lock:
            self._protocol.receive_data(data)
            self._flush()
        for frame in self._protocol.events_received():
            self._join(cast("Frame", frame))
        if self._protocol.current_size is None and not self._protocol.reader.buffer:
            self.wire.read_until(0)
            self._count()
        elif not self._timed:
            self._timed = True
            self.wire.read_until(now_ns() + round(self.core.limits.body_s * 1e9))

    def _join(self, frame: Frame) -> None:
        if frame.opcode is Opcode.TEXT:
            raise _Refused(CloseCode.UNSUPPORTED_DATA, "an observation is a binary message, not a text")
        if frame.opcode not in DATA_OPCODES:
            return
        if frame.fin and not self._message:
            message = bytes(frame.data)
        else:
            self._message += frame.data
            if not frame.fin:
                return
            message, self._message = bytes(self._message), bytearray()
        self._requests.put(WebsocketExchange(self, message, self._held.pop_all()))
        self._count()

    def _count(self) -> None:
        self._held.close()
        self._came = self._held.enter_context(self.core.in_flight.counted())
        self._timed = False

    # the thread that answers

    def _answer_all(self) -> None:
        while (exchange := self._requests.get()) is not None:
            with exchange.held:
                if self._open and not self.core.answer(exchange):
                    self.wire.hang_up()
            del exchange  # nothing of a request is kept while the next is waited for

    def flush(self, left_s: float) -> None:
        """Wait for the client to read what it was sent; raises Disconnected."""
        with self._lock:
            if self._open:
                self.wire.flush(left_s)

    def fail(self, reason: str) -> None:
        """Say what is wrong, and that nothing follows; raises Disconnected."""
        with self._lock, suppress(OSError):
            self._refuse(CloseCode.INTERNAL_ERROR, reason)
            self.wire.flush(LINGER_S)
            self.wire.socket.shutdown(socket.SHUT_WR)

    # both

    @property
    def _open(self) -> bool:
        with self._lock:
            return self._protocol.state is State.OPEN

    def send(self, message: bytes) -> None:
        """Send a message, without waiting for the client; raises Disconnected."""
        with self._lock:
            if not self._open:
                raise Disconnected
            self._protocol.send_binary(message)
            self._flush()

    def _refuse(self, code: int, reason: str) -> None:
        with self._lock, suppress(Disconnected):
            if self._open:
                self._protocol.send_text(reason[:ERROR_LETTERS].encode(errors="backslashreplace"))
                self._protocol.send_close(code, "see the text before")
                self._flush()

    def _flush(self) -> None:
        """Send what the protocol has to say; raises Disconnected."""
        for data in self._protocol.data_to_send():
            if data:
                self.wire.sendall(data)


class WebsocketExchange(observed.ActionsExchange):
    def __init__(self, connection: PolicyConnection, message: bytes, held: ExitStack) -> None:
        super().__init__()
        self.held = held
        self.trace.mark("network")
        self.disconnected = connection.wire.disconnected  # type: ignore[method-assign]
        self._connection, self._message = connection, message
        self._began_ns = self.trace.marks[0][1]

    def request(self) -> Request:
        observation, self._message = unpackb(self._message), b""
        self.trace.mark("msgpack_parse")
        extension = observed.take_extension(observation) if self._connection.native else None
        return observed.request_of(observation, extension, self.trace, self._connection.core.limits)

    def begin(self, request: Request) -> Request:
        self._started_ns = now_ns()
        return request

    def send(self, piece: Piece) -> bool:
        wanted = super().send(piece)
        if self._connection.streams:
            partial = {codec.TYPE: codec.PARTIAL, codec.ACTIONS: self._actions[-1][None]}
            partial[codec.INDICES] = np.array([len(self._actions) - 1])
            self._connection.send(packb(partial))
        return wanted

    def end(self) -> None:
        """Send the chunk, then the marks to our own client."""
        connection, trace, chunk = self._connection, self.trace, self.chunk()
        if not connection.streams:
            self.sent_whole()
        ended_ns = trace.token_ns[-1] if trace.token_ns else now_ns()
        timing = {str(INFER_MS): (ended_ns - self._started_ns) / 1e6}
        if connection.previous_ms is not None:
            timing[str(PREV_TOTAL_MS)] = connection.previous_ms
        kind = {codec.TYPE: codec.FINAL} if connection.streams else {}
        connection.send(packb({**kind, codec.ACTIONS: chunk, codec.TIMING: timing}))
        connection.previous_ms = (now_ns() - self._began_ns) / 1e6
        if connection.native:
            connection.send(packb(self.marks()))
        connection.flush(self.left_s())

    def fail(self, error: S2AError) -> None:
        """Say why in a text, and close, as openpi's server does."""
        self._connection.fail(str(error) or type(error).__name__)


def metadata_of(queued: Queued) -> Mapping[str, Any]:
    settings = queued.settings.model_dump() if queued.settings is not None else {}
    names = {"name": "engine", "horizon": "action_horizon", "action_dim": "action_dim"}
    extension = {key: settings[name] for name, key in names.items() if isinstance(settings.get(name), (str, int))}
    return {"server": codec.OURS, **extension, "provenance": queued.provenance}
