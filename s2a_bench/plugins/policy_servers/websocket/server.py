"""Our policy server: openpi's protocol on websockets' threaded server, which answers pings whatever the engine does.

A connection has three threads of the library: one reads, one answers its requests one after the other, and one sends
the pings that find dead clients, as openpi's own server does. The library bounds handshakes and messages, and rests
reading once two requests wait. Answers are sent while the engine is held: a client that takes nothing of one for
`SEND_S` is cut off.
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from threading import Event, Thread
from typing import Any, Final

import numpy as np
import websockets.version
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request as Handshake
from websockets.http11 import Response
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, S2AError
from s2a_bench.facts import INFER_MS
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.websocket import PREV_TOTAL_MS, STREAM_PATH, WebsocketOptions, codec
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import WebServer
from s2a_bench.transport.connections import GRACE_S, LINGER_S, PAUSE_S, timeval
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import POLL_S, Disconnected, Queued
from s2a_bench.types import Piece, Request

SEND_S: Final = 10.0
"""The longest time for a client to take nothing of what it is sent."""
ERROR_LETTERS: Final = 1000
_log = logging.getLogger(__name__)


class WebsocketServer(WebServer):
    def __init__(self, wiring: Wiring[WebsocketOptions], handler: Handler) -> None:
        super().__init__(wiring, handler, "ws", codec.SCHEME)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeval(SEND_S))  # connections inherit it
        self._metadata = packb(metadata_of(self._core.queued))
        self._most = wiring.limits.connections
        self._connections: set[ServerConnection] = set()
        self._answering: set[PolicyConnection] = set()
        self._stopped = Event()
        self._library: Server | None = None

    def describe(self) -> dict[str, str | int]:
        return {"server": "websockets", "version": websockets.version.version}

    def _listening(self) -> Server:
        return serve(
            self._handle,
            sock=self._listener,
            process_request=self._refusal,
            compression=None,
            server_header=None,
            open_timeout=self._core.limits.head_s,
            close_timeout=LINGER_S,
            max_size=self._core.limits.body_bytes,
            max_queue=1,
            logger=codec.QUIET,
        )

    def serve(self) -> None:
        """Accept until `stop`; then give running answers `GRACE_S`, and close."""
        accepting = Thread(target=self._accept, name="accept", daemon=True)  # so are the threads of its connections
        accepting.start()
        accepting.join()
        self._listener.close()
        ends = time.monotonic() + GRACE_S
        while self._answering and time.monotonic() < ends:
            time.sleep(POLL_S)
        code, reason = CloseCode.GOING_AWAY, "the server stops"
        closing = [Thread(target=each.close, args=(code, reason), daemon=True) for each in [*self._connections]]
        if self._library is not None:
            closing.append(Thread(target=self._library.shutdown, daemon=True))
        for thread in closing:
            thread.start()
        ends = time.monotonic() + 2 * LINGER_S
        for thread in closing:
            thread.join(max(0.0, ends - time.monotonic()))

    def stop(self) -> None:
        self._stopped.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        """Accept until `stop`; the library gives up where an accept fails, as it does without descriptors."""
        while not self._stopped.is_set():
            why = "the library has stopped"
            try:
                self._library = self._listening()
                self._library.serve_forever()
            except (OSError, RuntimeError) as error:
                why = str(error)
            if not self._stopped.wait(PAUSE_S):
                _log.warning("no connection can be accepted: %s", why)

    def _refusal(self, connection: ServerConnection, handshake: Handshake) -> Response | None:
        """Return the answer to a handshake that is refused, or asks for the server's health."""
        path = handshake.path.partition("?")[0]
        headers = ((name.lower(), value) for name, value in handshake.headers.raw_items())
        answer = self._access.refusal(path == codec.HEALTH, headers)
        if answer is None and path == codec.HEALTH:
            stuck = self._core.stuck()
            answer = (HTTPStatus.SERVICE_UNAVAILABLE, stuck) if stuck else (HTTPStatus.OK, "OK")
        elif answer is None and len(self._connections) >= self._most:
            answer = HTTPStatus.SERVICE_UNAVAILABLE, f"{self._most} connections are open already"
        if answer is None:
            return None
        response = connection.respond(answer[0], f"{answer[1]}\n")
        if answer[0] == HTTPStatus.UNAUTHORIZED:
            response.headers["WWW-Authenticate"] = codec.SCHEME
        return response

    def _handle(self, connection: ServerConnection) -> None:
        """Greet a client, and answer its requests one after the other."""
        client = PolicyConnection(connection)
        self._connections.add(connection)
        try:
            client.send(self._metadata)
            while True:
                self._answer(client, connection.recv())
                self._answering.discard(client)
        except (ConnectionClosed, Disconnected):  # a client that leaves is not a failure
            pass
        except Exception:
            _log.exception("a connection failed")
            raise
        finally:
            self._answering.discard(client)
            self._connections.discard(connection)

    def _answer(self, client: PolicyConnection, message: bytes | str) -> None:
        """Answer a request; raises Disconnected where no other can follow."""
        self._answering.add(client)
        if client.disconnected():
            raise Disconnected
        if isinstance(message, str):
            client.refuse(CloseCode.UNSUPPORTED_DATA, "an observation is a binary message, not a text")
            return
        exchange = WebsocketExchange(client, message, self._core.limits)
        try:
            exchange.held.enter_context(self._core.in_flight.counted())(len(message))
        except Busy as error:
            exchange.held.close()
            client.refuse(CloseCode.TRY_AGAIN_LATER, f"{error}; come again later")
            return
        del message  # the exchange gives it up once it is read
        if not self._core.answer(exchange):
            raise Disconnected


class PolicyConnection:
    """One client, and what the answers to its requests depend on."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        handshake = connection.request
        assert handshake  # noqa: S101 - for mypy
        self.native = codec.MARKS_HEADER in handshake.headers
        """Whether it is our client, which receives our marks."""
        self.streams = handshake.path.partition("?")[0].rstrip("/").endswith(STREAM_PATH)
        """Whether actions are sent one by one."""
        self.previous_ms: float | None = None
        """The duration of the previous request."""

    def send(self, message: bytes) -> None:
        """Send a message; raises Disconnected."""
        try:
            self._connection.send(message)
        except ConnectionClosed as error:
            raise Disconnected from error

    def disconnected(self) -> bool:
        return self._connection.state is not State.OPEN

    def refuse(self, code: CloseCode, reason: str) -> None:
        """Say in a text what is wrong, and close, as openpi's server does."""
        with suppress(ConnectionClosed):
            self._connection.send(reason[:ERROR_LETTERS].encode(errors="backslashreplace"), text=True)
            self._connection.close(code, "see the text before")


class WebsocketExchange(observed.ActionsExchange):
    def __init__(self, client: PolicyConnection, message: bytes, limits: Limits) -> None:
        super().__init__()
        self.trace.mark("network")
        self._client, self._message, self._limits = client, message, limits
        self._began_ns = self.trace.marks[0][1]

    def request(self) -> Request:
        observation, self._message = unpackb(self._message), b""
        self.trace.mark("msgpack_parse")
        extension = observed.take_extension(observation) if self._client.native else None
        return observed.request_of(observation, extension, self.trace, self._limits)

    def begin(self, request: Request) -> Request:
        self._started_ns = now_ns()
        return request

    def disconnected(self) -> bool:
        return self._client.disconnected()

    def send(self, piece: Piece) -> bool:
        wanted = super().send(piece)
        if self._client.streams:
            partial = {codec.TYPE: codec.PARTIAL, codec.ACTIONS: self._actions[-1][None]}
            partial[codec.INDICES] = np.array([len(self._actions) - 1])
            self._client.send(packb(partial))
        return wanted

    def end(self) -> None:
        """Send the chunk, then the marks to our own client."""
        client, trace, chunk = self._client, self.trace, self.chunk()
        if not client.streams:
            self.sent_whole()
        ended_ns = trace.token_ns[-1] if trace.token_ns else now_ns()
        timing = {str(INFER_MS): (ended_ns - self._started_ns) / 1e6}
        if client.previous_ms is not None:
            timing[str(PREV_TOTAL_MS)] = client.previous_ms
        kind = {codec.TYPE: codec.FINAL} if client.streams else {}
        client.send(packb({**kind, codec.ACTIONS: chunk, codec.TIMING: timing}))
        client.previous_ms = (now_ns() - self._began_ns) / 1e6
        if client.native:
            client.send(packb(self.marks()))

    def fail(self, error: S2AError) -> None:
        self._client.refuse(CloseCode.INTERNAL_ERROR, str(error) or type(error).__name__)


def metadata_of(queued: Queued) -> Mapping[str, Any]:
    settings = queued.settings.model_dump() if queued.settings is not None else {}
    names = {"name": "engine", "horizon": "action_horizon", "action_dim": "action_dim"}
    extension = {key: settings[name] for name, key in names.items() if isinstance(settings.get(name), (str, int))}
    return {"server": codec.OURS, **extension, "provenance": queued.provenance}
