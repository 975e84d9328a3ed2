"""The WebSocket client: fill the template, pack, send, read the actions, and mark each step.

Our own server, which its greeting names, sends its marks in one more frame after an answer. A foreign one sends none:
all from the last byte that was packed to the answer is the stage `server`, and where it tells ``infer_ms`` that much of
it is `inference`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from typing import Any
from urllib.parse import SplitResult, urlsplit, urlunsplit

import numpy as np
from PIL import Image

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied, UsageError
from s2a_bench.facts import INFER_MS, PAYLOAD_BYTES, RECONNECTS
from s2a_bench.machine.doctor import Finding
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.observation import CAMERAS, EXTENSION, ExternalServer, names, template_of
from s2a_bench.plugins.policy_servers.policy_client import PolicyClient, policy_picture
from s2a_bench.plugins.policy_servers.websocket import STREAM, STREAM_PATH, TIMING, WebsocketOptions, codec
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.plugins.policy_servers.websocket.link import Broken, Connection
from s2a_bench.provenance import Provenance
from s2a_bench.secrets import struck
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import read_key
from s2a_bench.transport.risks import PATIENCE_S, idle_cut
from s2a_bench.types import Action, Frame, Piece, Request
from s2a_bench.vectors import actions_of


class WebsocketClient(PolicyClient[WebsocketOptions]):
    def __init__(self, wiring: Wiring[WebsocketOptions], alive: Callable[[], bool]) -> None:
        super().__init__(wiring, alive)
        self._streams = wiring.variant == STREAM
        self._server = ExternalServer() if self._native else self._template.server
        parts = urlsplit(self._url)
        if self._server.path and not parts.path.strip("/"):
            self._url = urlunsplit(parts._replace(path=self._server.path))
        if self._native and self._streams:
            self._url += STREAM_PATH
        key = read_key(wiring.options.api_key_env)
        self._headers = {"Authorization": f"{codec.SCHEME} {key}"} if key else {}
        self._headers[codec.MARKS_HEADER] = "1"
        self._connection: Connection | None = None
        self._metadata: dict[str, str] = {}
        self._ignored: list[tuple[int, str]] = []
        self._provenance: dict[str, str] = {}

    def _answer(self, request: Request, bounds: Bounds, trace: Trace) -> Iterator[Piece]:
        try:
            if self._template.unnamed and not self._native and self._connection is None:
                self._connected(bounds)
                trace.mark("connect")
            body = self._pack(request, trace)
            message = self._sent(body, len(request.images), bounds, trace)
            trace.provenance = self._provenance
            yield from self._actions(message, trace)
        except Broken as error:
            if not self._alive():
                raise ServerDied(f"the server has ended: {error}") from error
            raise RequestFailed(str(error), starting=error.starting) from error

    def _pack(self, request: Request, trace: Trace) -> bytes:
        observation = self._observation(request, trace)
        if self._native:
            observation[EXTENSION] = observed.extension_of(request)
        body = packb(observation, text_keys=self._server.text_keys)
        trace.mark("msgpack_pack")
        trace.facts[PAYLOAD_BYTES] = len(body)
        return body

    def _picture(self, frame: Frame, place: int, trace: Trace) -> Any:
        """Return a picture; a map is made with Pillow, as vla-eval's robots do, ten times slower than OpenCV."""
        payload = self._wiring.options.payload
        if payload == "raw" or not self._server.image_maps:
            return super()._picture(frame, place, trace)
        rgb, file = policy_picture(frame, "raw", trace), BytesIO()
        Image.fromarray(rgb).save(file, payload, quality=95)
        trace.mark("image_encode")
        return {"__image__": True, "format": payload, "data": file.getvalue(), "shape": rgb.shape}

    def _sent(self, body: bytes, cameras: int, bounds: Bounds, trace: Trace) -> bytes:
        """Send, once more if the server had just closed the kept connection; return the answer's first message."""
        if self._connection is not None:
            if self._connection.alive(bounds):
                with suppress(Broken):
                    return self._exchanged(self._connection, body, cameras)
            trace.facts[RECONNECTS] = 1.0
            self._abandon()
        connection = self._connected(bounds)
        trace.mark("connect")
        return self._exchanged(connection, body, cameras)

    def _connected(self, bounds: Bounds) -> Connection:
        self._connection = None
        connection = Connection(self._url, self._headers, bounds, self._wiring.timeout_s, self._server.idle_s)
        try:
            if self._server.greets:
                self._greeted(connection)
            if self._server.reset is not None:
                connection.send(packb(self._server.reset))
                self._ready(connection.receive())
        except BaseException:
            connection.abandon()
            raise
        self._connection = connection
        return connection

    def _exchanged(self, connection: Connection, body: bytes, cameras: int) -> bytes:
        for index, path in self._ignored:
            if index < cameras:
                keys, cure = ", ".join(map(repr, self._listed)), "take a template with these keys, or write one"
                name = self._template.name
                raise UsageError(f"`template` {name}: the server ignores '{path}', it reads {keys}; {cure}")
        connection.send(body)
        return self._message(connection)

    def _greeted(self, connection: Connection) -> None:
        metadata = unpackb(self._message(connection))
        if not isinstance(metadata, dict):
            raise RequestFailed(f"{self._url}: its metadata is {type(metadata).__name__}, not a dictionary")
        origin = metadata.get("provenance")
        self._provenance = Provenance.from_dict(origin if isinstance(origin, dict) else {}).to_dict()
        self._native = metadata.get("server") == codec.OURS
        plain = {name: value for name, value in metadata.items() if isinstance(value, (str, int, float, bool))}
        self._metadata = {str(name)[:64]: struck(str(value))[:64] for name, value in list(plain.items())[:32]}
        described = metadata.get("input")
        listed = described.get("image_keys") if isinstance(described, dict) else None
        self._listed = [struck(str(key))[:64] for key in listed[:CAMERAS]] if isinstance(listed, list) else []
        self._ignored = self._template.ignored(self._listed) if self._listed else []
        if self._template.unnamed and not (self._native or self._listed):
            raise RequestFailed(f"{self._url}: its greeting lists no pictures; take a template that names them")

    def _ready(self, answer: bytes | str) -> None:
        """Read the answer to a reset, a message or, as DreamZero has it, a text; a traceback is an error."""
        if not isinstance(answer, str):
            self._check(unpackb(answer))
        elif answer.lstrip().startswith("Traceback"):
            raise self._failed(answer)

    def _message(self, connection: Connection) -> bytes:
        """Return the next binary message; a text is an error."""
        message = connection.receive()
        if isinstance(message, str):
            raise self._failed(message)
        return message

    def _check(self, answer: Any) -> None:
        """Raise the error that an answer is, in the server's words."""
        reason = answer.get(codec.ERROR) if isinstance(answer, dict) else None
        if _kind(answer) == codec.ERROR or (isinstance(reason, (str, dict)) and reason):
            while isinstance(answer, dict):
                answer = next((answer[key] for key in codec.ERROR_KEYS if key in answer), "")
            if isinstance(answer, str):
                raise self._failed(answer)

    def _actions(self, message: bytes, trace: Trace) -> Iterator[Action]:
        """Yield the actions of an answer; after the last, complete the trace."""
        assert self._connection  # noqa: S101 - for mypy
        count, first_ns = 0, 0
        while True:
            answer = unpackb(message)
            self._check(answer)
            actions = actions_of(self._server.actions_in(answer))
            last = not self._streams or _kind(answer) != codec.PARTIAL
            if not last:
                actions = [Action(count + index, action.values) for index, action in enumerate(actions)]
            elif count > len(actions):
                raise RequestFailed(f"{self._url}: {count} actions came, and {len(actions)} of them are the whole")
            else:
                actions = actions[count:]
            first_ns = first_ns or now_ns()
            yield from actions
            count += len(actions)
            if last:
                break
            message = self._message(self._connection)
        if isinstance(answer, dict) and isinstance(timing := answer.get(codec.TIMING), dict):
            plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in timing.items()}
            trace.learn({fact: plain[name] for name, fact in TIMING.items() if name in plain})
        if self._native:
            trace.receive(observed.remote_of(unpackb(self._message(self._connection))))
        infer_ns = round(trace.facts.get(INFER_MS, 0) * 1e6)
        if trace.remote is not None:
            trace.marks.append(("return", first_ns))
        elif 0 < infer_ns < first_ns - trace.marks[-1][1] and not self._streams:
            trace.marks += [("server", first_ns - infer_ns), ("inference", first_ns)]
        else:
            trace.marks.append(("server", first_ns))

    def describe(self) -> dict[str, str]:
        """Return the server and its metadata, for the manifest; connects to a foreign server."""
        if not self._native and self._connection is None:
            self._connected(self._wiring.bounds(self._url, 1))
        return {**super().describe(), **self._metadata}

    def _abandon(self) -> None:
        if self._connection is not None:
            self._connection.abandon()
            self._connection = None

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._abandon()


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Shake hands without a key, offering compression; no request is sent."""
    servers = {name: template_of(name).server for name in names()}
    path = parts.path.rstrip("/")
    if cut := {name: each.idle_s for name, each in servers.items() if each.idle_s and each.path == path}:
        cure = f"--template {' or '.join(cut)}, of servers with this path: it keeps the connection open"
        yield idle_cut(min(cut.values()), cure)
    url = urlunsplit(parts)
    with closing(Connection(url, {}, Bounds(url, PATIENCE_S, 0), PATIENCE_S, compression="deflate")) as connection:
        if connection.compresses:
            what = "it compresses for clients that offer it, as libraries do: each observation is deflated first"
            cure = "connect with compression=None, as openpi's and s2a-bench's clients do, or turn it off in the server"
            yield Finding("compression", "advice", what, cure)


def _kind(answer: Any) -> str:
    kind = answer.get(codec.TYPE) if isinstance(answer, dict) else None
    return kind if isinstance(kind, str) else ""
