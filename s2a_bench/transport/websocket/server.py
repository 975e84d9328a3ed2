"""Our policy server: openpi's protocol, which reports health and answers pings whatever the engine does."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import numpy as np
import websockets.version
from websockets.server import ServerProtocol

from s2a_bench.clock import now_ns
from s2a_bench.errors import EngineError, S2AError
from s2a_bench.facts import INFER_MS
from s2a_bench.transport import Handler, Wiring, observed
from s2a_bench.transport.access import WebServer
from s2a_bench.transport.connections import Connections, Wire
from s2a_bench.transport.serving import Disconnected, Exchange, Queued
from s2a_bench.transport.websocket import PREV_TOTAL_MS, WebsocketOptions, codec
from s2a_bench.transport.websocket.codec import packb, unpackb
from s2a_bench.transport.websocket.connection import PolicyConnection
from s2a_bench.types import Action, Piece, Request


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
        PolicyConnection(wire, self._core, self._access, self._metadata, WebsocketExchange).serve()


class WebsocketExchange(Exchange):
    parse_stage = "msgpack_parse"

    def __init__(self, connection: PolicyConnection, message: bytes) -> None:
        super().__init__()
        self.trace.mark("network")
        self.disconnected = connection.wire.disconnected  # type: ignore[method-assign]
        self._connection, self._message = connection, message
        self._began_ns = self.trace.marks[0][1]
        self._actions: list[Any] = []

    def request(self) -> Request:
        observation, self._message = unpackb(self._message), b""
        self.trace.mark("msgpack_parse")
        extension = observed.take_extension(observation) if self._connection.native else None
        return observed.request_of(observation, extension, self.trace, self._connection.core.limits)

    def begin(self, request: Request) -> Request:
        self._started_ns = now_ns()
        return request

    def send(self, piece: Piece) -> bool:
        if self.disconnected():
            raise Disconnected
        if not isinstance(piece, Action):
            raise EngineError(
                "the engine answers with tokens, and this protocol knows actions; choose `answer` actions"
            )
        self._actions.append(piece.values)
        if self._connection.streams:
            partial = {codec.TYPE: codec.PARTIAL, codec.ACTIONS: piece.values[None]}
            partial[codec.INDICES] = np.array([len(self._actions) - 1])
            self._connection.send(packb(partial))
        return True

    def end(self) -> None:
        """Send the chunk, then to our own client the marks, which may take time to find."""
        if not self._actions:
            raise EngineError("the engine answered with no action at all")
        connection, trace = self._connection, self.trace
        if not connection.streams:
            self.sent_whole()
        ended_ns = trace.token_ns[-1] if trace.token_ns else now_ns()
        timing = {str(INFER_MS): (ended_ns - self._started_ns) / 1e6}
        if connection.previous_ms is not None:
            timing[str(PREV_TOTAL_MS)] = connection.previous_ms
        kind = {codec.TYPE: codec.FINAL} if connection.streams else {}
        connection.send(packb({**kind, codec.ACTIONS: np.stack(self._actions), codec.TIMING: timing}))
        connection.previous_ms = (now_ns() - self._began_ns) / 1e6
        if connection.native:
            connection.send(packb(observed.remote_message(trace.to_remote())))
        connection.flush(self.left_s())

    def fail(self, error: S2AError) -> None:
        """Say why in a text, and close, as openpi's server does."""
        self._connection.fail(str(error) or type(error).__name__)


def metadata_of(queued: Queued) -> Mapping[str, Any]:
    settings = queued.settings.model_dump() if queued.settings is not None else {}
    names = {"name": "engine", "horizon": "action_horizon", "action_dim": "action_dim"}
    extension = {key: settings[name] for name, key in names.items() if isinstance(settings.get(name), (str, int))}
    return {"server": codec.OURS, **extension, "provenance": queued.provenance}
