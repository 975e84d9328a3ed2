"""The client of GR00T's protocol: fill the template, pack, send, read the chunk, and mark each step.

Our server sends its marks as a second message behind the chunk; a server that runs already is ours if its modality
configurations say so. A foreign one sends none: all from the last byte that was packed to the chunk is the stage
`server`. A connection whose request failed is thrown away, so that no late answer is taken for the next one's.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any, Final
from urllib.parse import urlsplit

import zmq

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.observation import EXTENSION
from s2a_bench.plugins.policy_servers.policy_client import PolicyClient
from s2a_bench.plugins.policy_servers.zmq import ZMQ, ZmqOptions, layouts
from s2a_bench.plugins.policy_servers.zmq.wire import PictureFile, pack, read
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import read_key
from s2a_bench.types import Frame, Piece, Pixels, Request

ANSWER_BYTES: Final = 16 << 20
"""Most bytes of an answer; libzmq takes no more."""
POLL_MS: Final = 20
"""Interval at which a waiting request checks its connection."""
KEPT_FILES: Final = 16
"""Most pictures whose memory is kept for the next request."""
WRONG_POLICY: Final = b"ERROR"
"""The reply of some GR00T servers that serve another kind of policy."""


class ZmqClient(PolicyClient[ZmqOptions]):
    def __init__(self, wiring: Wiring[ZmqOptions], alive: Callable[[], bool]) -> None:
        """Prepare; request the layout of a foreign server, unless the options name it."""
        super().__init__(wiring, alive)
        self._key = read_key(wiring.options.api_key_env)
        self._files: dict[tuple[int, int, int], PictureFile] = {}
        self._connection: Dealer | None = None
        self._connected = False
        self._layout: str = wiring.options.layout
        answer: Any = None
        if self._layout == layouts.AUTO:
            answer, marks = (None, set()) if self._native else self._configurations()
            self._native, self._layout = self._native or layouts.OURS in marks, layouts.marked(marks)
            self._template = ZMQ.template(wiring.options.but(layout=self._layout))
        self._modalities = {} if self._native or wiring.options.template else layouts.modalities_in(answer)

    def _configurations(self) -> tuple[Any, set[str]]:
        """Return the server's modality configurations and their marks: its layout, and whether it is ours."""
        bounds = self._wiring.bounds(self._url, 1)
        with closing(Dealer(self._url, self._wiring.timeout_s, self._alive, bounds)) as connection:
            asks = pack({layouts.ENDPOINT: layouts.MODALITIES, **self._token()})
            return self._read(connection.exchange(asks, bounds))

    def _answer(self, request: Request, bounds: Bounds, trace: Trace) -> Iterator[Piece]:
        connection = self._open(bounds, trace)
        actions = layouts.actions_in(self._checked(connection.exchange(self._pack(request, trace), bounds)))
        seen_ns = now_ns()
        yield from actions
        if self._native:
            trace.receive(observed.remote_of(self._checked(connection.receive(bounds))))
        trace.marks.append(("return" if self._native else "server", seen_ns))

    def _open(self, bounds: Bounds, trace: Trace) -> Dealer:
        """Return the kept connection, or a new one that both sides have greeted over, marking `connect`."""
        if self._connection is not None and not self._connection.stands():
            self.close()
        if self._connection is None:
            if self._connected:
                trace.facts[RECONNECTS] = 1.0
            self._connection = Dealer(self._url, self._wiring.timeout_s, self._alive, bounds)
            self._connected = True
            trace.mark("connect")
        return self._connection

    def _pack(self, request: Request, trace: Trace) -> memoryview:
        if self._modalities:
            self._template = layouts.template_of(self._layout, self._modalities, len(request.state))
            self._modalities = {}
        seen = self._observation(request, trace)
        data = seen if self._layout == layouts.N1_5 else {layouts.OBSERVATION: seen, "options": None}
        message: dict[str, Any] = {layouts.ENDPOINT: layouts.GET_ACTION, layouts.DATA: data, **self._token()}
        if self._native:
            message[EXTENSION] = observed.extension_of(request)
        files = {file.address: file for file in self._files.values()}
        body = pack(message, files, maps=self._layout == layouts.N1_7)
        trace.mark("msgpack_pack")
        trace.facts[PAYLOAD_BYTES] = len(body)
        return body

    def _picture(self, frame: Frame, place: int, trace: Trace) -> Pixels:
        """Return a picture as it is sent; YUYV frames are converted straight into the send buffer."""
        if self._wiring.options.payload != "raw" or frame.encoding != "yuv422_yuy2":
            return super()._picture(frame, place, trace)
        if len(self._files) > KEPT_FILES:
            self._files.clear()
        key = place, frame.height, frame.width
        file = self._files.get(key) or self._files.setdefault(key, PictureFile(frame.height, frame.width))
        yuyv_to_rgb(frame.data, file.pixels)
        trace.mark("convert")
        return file.pixels

    def _token(self) -> dict[str, str]:
        return {layouts.TOKEN: self._key} if self._key else {}

    def _read(self, message: bytes) -> tuple[Any, set[str]]:
        """Return an answer, errors included, and its marks; raises RequestFailed for another protocol."""
        if message == WRONG_POLICY:
            raise RequestFailed(f"{self._url} answered {WRONG_POLICY.decode()}: it serves another kind of policy")
        return read(message)

    def _checked(self, message: bytes) -> Any:
        """Return an answer; raises RequestFailed for an error."""
        answer, _ = self._read(message)
        if isinstance(answer, dict) and layouts.ERROR in answer:
            wait_s = answer.get(layouts.RETRY)
            number = isinstance(wait_s, (int, float)) and wait_s > 0
            raise self._failed(str(answer[layouts.ERROR]), wait_s if number else None)
        return answer

    def describe(self) -> dict[str, str]:
        template = {"template": layouts.MODALITIES} if self._modalities else {}
        return {**super().describe(), **template, "layout": self._layout}


class Dealer:
    """One DEALER socket and its connection, bounded in time and bytes, that speaks as a REQ socket does.

    libzmq connects once (no RECONNECT_IVL) and lets a message in only after both sides have greeted (IMMEDIATE), so
    the socket takes messages (POLLOUT) for as long as the connection stands.
    """

    def __init__(self, url: str, timeout_s: float, alive: Callable[[], bool], bounds: Bounds) -> None:
        """Connect, and wait until both sides have greeted; raises ServerDied or RequestFailed."""
        self._url, self._timeout_s, self._alive = url, timeout_s, alive
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.maxmsgsize = ANSWER_BYTES
        self._socket.immediate = True
        self._socket.reconnect_ivl = -1
        self._socket.ipv6 = "[" in url
        try:
            self._check_port(min(timeout_s, bounds.left_s()))
            self._socket.connect(url)
            self._wait(zmq.POLLOUT, bounds)
        except BaseException:
            self.close()
            raise

    def stands(self) -> bool:
        return bool(self._socket.poll(0, zmq.POLLOUT))

    def exchange(self, body: memoryview, bounds: Bounds) -> bytes:
        try:
            self._socket.send_multipart([b"", body], zmq.NOBLOCK, copy=False)
        except zmq.ZMQError as error:
            raise RequestFailed(f"{self._url}: {error.strerror}") from error
        return self.receive(bounds)

    def receive(self, bounds: Bounds) -> bytes:
        """Return the next message."""
        self._wait(zmq.POLLIN, bounds)
        frames = self._socket.recv_multipart()
        if len(frames) != 2:  # noqa: PLR2004 - an empty one, and the message
            raise RequestFailed(f"{self._url} answered with {len(frames)} frames, not with an empty one and a message")
        bounds.count_bytes(len(frames[1]))
        return frames[1]

    def _check_port(self, seconds: float) -> None:
        """Raise ServerDied if nothing listens: libzmq does not tell."""
        parts = urlsplit(self._url)
        try:
            socket.create_connection((parts.hostname or "", parts.port or 0), seconds).close()
        except (OSError, UnicodeError) as error:  # of a name that none can have
            raise ServerDied(f"nothing answers at {self._url}: {error}") from error

    def _wait(self, event: int, bounds: Bounds) -> None:
        """Wait until the socket can be written or read; raises what says why waiting has to end."""
        ends_ns = now_ns() + round(min(self._timeout_s, bounds.left_s()) * 1e9)
        while not self._socket.poll(POLL_MS, event):
            if not self._alive():
                raise ServerDied(f"the server at {self._url} has ended")
            if event == zmq.POLLIN and not self.stands() and not self._socket.poll(0, event):
                raise RequestFailed(f"{self._url} broke the connection", starting=True)
            bounds.left_s()
            if now_ns() > ends_ns and event == zmq.POLLOUT:
                what = f"{self._url} did not greet within {self._timeout_s:g} s; is it a ZeroMQ peer?"
                raise RequestFailed(what, starting=True)
            if now_ns() > ends_ns:
                raise RequestFailed(f"{self._url} was silent for too long: {self._timeout_s:g} s", starting=True)

    def close(self) -> None:
        self._context.destroy(0)
