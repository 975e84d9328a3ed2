"""Our policy server: GR00T's protocol on a ROUTER socket, so that one request does not block all other clients.

Its threads take turns in waiting for a message. libzmq allows a socket to one thread at a time, which a lock sees to:
each sends its answer by itself. So the one that waits must not do so in the socket: it waits for the socket's
descriptor, which tells of changes (ZMQ_FD).
"""

from __future__ import annotations

import hmac
import select
import socket
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotYet
from contextlib import ExitStack, suppress
from functools import partial
from threading import Event, Lock, Semaphore
from typing import Any, Final, NamedTuple

import zmq

from s2a_bench.errors import Busy, RequestFailed, S2AError, TransportError
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.zmq import ZmqOptions, layouts
from s2a_bench.plugins.policy_servers.zmq.watch import Connection, ConnectionWatch
from s2a_bench.plugins.policy_servers.zmq.wire import pack, read
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.listening import cannot_bind, in_url, key_for, split_address
from s2a_bench.transport.serving import RETRY_AFTER_S, Core, SharedSourceWorkers, client_error
from s2a_bench.types import Request

POLL_MS: Final = 100
"""How often it is looked whether connections have begun or ended while nothing comes over them."""
QUEUED: Final = 8
"""Messages of one client that libzmq keeps for us; those beyond wait at the client."""
READING: Final = 16
"""Requests under way beyond those that may wait for the engine."""
ENVELOPE: Final = 4
"""Most frames before a message: the identity, those of proxies, an empty one."""
KEPT: Final = 128
"""The latest requests whose marks are kept until requested; those of a long answer are half a megabyte."""
WANTED_S: Final = 0.005
"""Marks are computed when they are requested, or after this time, so that they do not delay the answer."""


class ZmqServer:
    """A server on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[ZmqOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was, without it 127.0.0.1 and any port.

        Raises PortInUse, and UsageError for a public address without a key or `no_auth`.
        """
        name, port = split_address(wiring.address, "tcp")
        options, limits = wiring.options, wiring.limits
        host = _resolved(name)
        self._key = key_for(host, options.api_key_env, no_auth=options.no_auth).encode()
        self._layout: str = options.layout
        self._core = Core(handler, limits)
        self._marks = Marks()
        self._room = Semaphore(limits.waiting + READING)
        self._stopped = Event()
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._lock = Lock()
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        self._router.linger = 0
        self._router.rcvhwm = self._router.sndhwm = QUEUED
        self._router.ipv6 = ":" in host
        self._router.maxmsgsize = limits.body_bytes
        self._router.handshake_ivl = round(limits.head_s * 1e3)
        self._watch = ConnectionWatch(self._router)
        try:
            self._router.bind(f"tcp://{in_url(host)}:{'*' if port == '0' else port}")
        except zmq.ZMQError as error:
            self._close()
            raise cannot_bind(host, port, error.errno, error.strerror) from error
        self.address: str = self._router.get_string(zmq.LAST_ENDPOINT)
        self._poller = select.poll()
        for readable in (self._router.FD, self._woken, self._watch.monitor.FD):
            self._poller.register(readable, select.POLLIN)

    def describe(self) -> dict[str, str | int]:
        return {"server": "pyzmq", "version": zmq.pyzmq_version(), "libzmq": zmq.zmq_version()}

    def serve(self) -> None:
        workers = SharedSourceWorkers(self._next, self._stopped)
        workers.start()
        self._stopped.wait()
        self._close()

    def stop(self) -> None:
        self._stopped.set()
        self._rouse()

    def _next(self) -> Callable[[], None] | None:
        frames = self._received()
        if not frames:
            self._poller.poll(POLL_MS)
            with suppress(OSError):
                self._woken.recv(4096)
            frames = self._received()
        trace = Trace()
        trace.mark("network")
        return self._taken(frames, trace) if frames else None

    def _received(self) -> list[Any]:
        """Return the frames of a message that is there, at most one more than a request may have."""
        with self._lock:
            if self._stopped.is_set():
                return []
            self._watch.hear()
            self._watch.keep(self._core.limits.connections)
            try:
                frames = [self._router.recv(zmq.NOBLOCK, copy=False)]
            except zmq.Again:
                return []
            while frames[-1].more and len(frames) <= ENVELOPE:
                frames.append(self._router.recv(zmq.NOBLOCK, copy=False))
            rest = frames[-1]
            while rest.more:  # only reading it rids libzmq of a message; a million frames take 0.6 s
                rest = self._router.recv(zmq.NOBLOCK, copy=False)
        return frames

    def _taken(self, frames: list[Any], trace: Trace) -> Callable[[], None] | None:
        """Return what answers a message: one frame, after an envelope that ends with an empty one."""
        try:
            connection = self._watch.of(frames[-1].get(zmq.SRCFD))
        except zmq.ZMQError:
            return None  # before ZMTP 3 (2013) messages do not tell where they are from; so does noise like it
        if len(frames) > ENVELOPE or len(frames) < 3 or len(frames[-2]):  # noqa: PLR2004 - identity, empty, message
            error = RequestFailed("a request is one frame behind an empty one")
            self._send([frames[0].bytes, b"", _error(error)])
            return None
        client = ReplyAddress([frame.bytes for frame in frames[:-1]], connection, self._send)
        with ExitStack() as held:
            try:
                held.enter_context(self._core.in_flight.counted())(len(frames[-1]))
                if not self._room.acquire(blocking=False):
                    raise Busy("too many requests are under way; come again later", retry_after_s=RETRY_AFTER_S)
            except RequestFailed as error:
                client.say(_error(error))
                return None
            held.callback(self._room.release)
            return partial(self._serve, client, frames[-1], trace, held.pop_all())

    def _serve(self, client: ReplyAddress, frame: Any, trace: Trace, held: ExitStack) -> None:
        with held:
            try:
                message, marks = read(frame.buffer)
                trace.mark("msgpack_parse")
                self._check(message)
                endpoint = message.get(layouts.ENDPOINT, layouts.GET_ACTION)
                extension = observed.take_extension(message)
                request = (client.name, str(extension.get("id"))) if extension is not None else None
                if endpoint == layouts.GET_ACTION:
                    promised = self._marks.promise(request) if request else None
                    self._core.answer(ZmqExchange(client, message, marks, extension, trace, promised, self._core))
                    if promised is not None:
                        promised.marks.cancel()  # if the answer has failed
                elif endpoint == layouts.MARKS and request:
                    client.say(self._marks.take(request, self._core.limits.answer_s))
                else:
                    client.say(pack(self._reply(endpoint)))
            except Exception as error:  # noqa: BLE001 - the client must hear of it, whatever broke
                client.say(_error(client_error(error)))

    def _check(self, message: Any) -> None:
        """Raise RequestFailed for a message that is none, or has not the key, compared in constant time."""
        if not isinstance(message, dict):
            raise RequestFailed(f"a request is a map, not {type(message).__name__}")
        given = message.get(layouts.TOKEN)
        token = given.encode(errors="replace") if isinstance(given, str) else b""
        if self._key and not hmac.compare_digest(token, self._key):
            raise RequestFailed(f"Unauthorized: this server wants its key as {layouts.TOKEN}")

    def _reply(self, endpoint: Any) -> Any:
        if endpoint == layouts.PING:
            if stuck := self._core.stuck():
                raise RequestFailed(stuck)
            return {"status": "ok", "message": "Server is running"}
        if endpoint == layouts.MODALITIES:
            return layouts.modalities(self._layout)
        if endpoint == layouts.RESET:
            return {}
        if endpoint == layouts.KILL:
            raise RequestFailed("this server is not ended over the network: stop its process")
        known = f"{layouts.GET_ACTION}, {layouts.PING}, {layouts.RESET}, {layouts.MODALITIES}"
        raise RequestFailed(f"Unknown endpoint: {str(endpoint)[:80]!r} is none of {known}")

    def _send(self, frames: list[Any]) -> None:
        with self._lock:
            if self._router.closed:
                return
            with suppress(zmq.ZMQError):  # the client has gone, or does not read
                self._router.send_multipart(frames, zmq.NOBLOCK)
            came = self._router.getsockopt(zmq.EVENTS) & int(zmq.POLLIN)  # type: ignore[operator]
        if came:  # sending has taken note of it, so that the descriptor no longer tells
            self._rouse()

    def _rouse(self) -> None:
        with suppress(OSError):  # it is awake already, or has ended
            self._wake.send(b"\0")

    def _close(self) -> None:
        with self._lock:
            self._watch.close()
            self._wake.close()
            self._woken.close()
            self._context.destroy(0)


class ReplyAddress:
    def __init__(self, envelope: list[bytes], connection: Connection, send: Callable[[list[Any]], None]) -> None:
        self.name = envelope[0]
        self.connection = connection
        self._envelope, self._send = envelope, send

    def say(self, message: bytes | memoryview) -> None:
        self._send([*self._envelope, message])


class ZmqExchange(observed.ActionsExchange):
    def __init__(
        self,
        client: ReplyAddress,
        message: dict[Any, Any],
        marks: set[str],
        extension: dict[Any, Any] | None,
        trace: Trace,
        promised: Promise | None,
        core: Core,
    ) -> None:
        """Answer ``message``; its marks are ``promised`` to a client of ours, which sent an ``extension``."""
        super().__init__(trace)
        self._client, self._data, self._extension, self._core = client, message.get(layouts.DATA), extension, core
        self._promised = promised
        self._maps = layouts.marked(marks) == layouts.N1_7

    def request(self) -> Request:
        self._observation, self._layout = layouts.observation_in(self._data)
        return observed.request_of(self._observation, self._extension, self.trace, self._core.limits)

    def end(self) -> None:
        """Send the chunk, then find the marks for our own client."""
        answer = layouts.answer_of(self._observation, self._layout, self.chunk())
        self.sent_whole()
        self._client.say(pack(answer, maps=self._maps))
        if self._promised is not None:
            self._promised.wanted.wait(WANTED_S)
            self._promised.marks.set_result(bytes(pack(self.marks())))

    def fail(self, error: S2AError) -> None:
        self._client.say(_error(error))

    def disconnected(self) -> bool:
        return self._client.connection.disconnected


class Promise(NamedTuple):
    """The marks of a request, and whether its client has requested them."""

    marks: Future[bytes]
    wanted: Event


class Marks:
    """The marks of the latest requests of our clients, each requested once."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._promises: OrderedDict[tuple[bytes, str], Promise] = OrderedDict()

    def promise(self, request: tuple[bytes, str]) -> Promise:
        promised = Promise(Future(), Event())
        with self._lock:
            self._promises[request] = promised
            if len(self._promises) > KEPT:
                self._promises.popitem(last=False)
        return promised

    def take(self, request: tuple[bytes, str], seconds: float) -> bytes:
        """Wait for the marks of a request; raises RequestFailed for one that is not known."""
        with self._lock:
            promised = self._promises.pop(request, None)
        if promised is not None:
            promised.wanted.set()
            with suppress(CancelledError, NotYet):
                return promised.marks.result(seconds)
        raise RequestFailed("unknown request, or its marks were requested before")


def _error(error: S2AError) -> memoryview:
    retry_s = error.retry_after_s if isinstance(error, RequestFailed) else None
    reply = {layouts.ERROR: str(error) or type(error).__name__}
    return pack({**reply, layouts.RETRY: retry_s} if retry_s else reply)


def _resolved(host: str) -> str:
    """Return the address of a host, for libzmq binds no names."""
    try:
        return host if ":" in host else socket.gethostbyname(host)
    except OSError as error:
        raise TransportError(f"`host`: '{host}' is no address of this machine: {error}") from error
