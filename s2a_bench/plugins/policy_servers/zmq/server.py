"""Our policy server: GR00T's protocol on a ROUTER socket, so that one request does not block all other clients.

One thread at a time has the ROUTER: it sends finished replies, which the others push to it, and waits for the next
request, which it then answers while another thread has the ROUTER.
"""

from __future__ import annotations

import hmac
import socket
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from threading import Event, Lock, Semaphore
from time import sleep
from typing import Any, Final, TypeAlias

import zmq

from s2a_bench.errors import Busy, RequestFailed, S2AError, TransportError
from s2a_bench.plugins.policy_servers import observed
from s2a_bench.plugins.policy_servers.zmq import ZmqOptions, layouts
from s2a_bench.plugins.policy_servers.zmq.wire import pack, read
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.listening import cannot_bind, in_url, key_for, split_address
from s2a_bench.transport.serving import RETRY_AFTER_S, Core, SharedSourceWorkers, client_error
from s2a_bench.types import Request

POLL_MS: Final = 100
"""The longest wait for a message of a server that stops."""
QUEUED: Final = 8
"""Messages of one client that libzmq keeps for us; those beyond wait at the client."""
READING: Final = 16
"""Requests under way beyond those that may wait for the engine."""
ENVELOPE: Final = 4
"""Frames kept before a message: the identity, those of proxies, an empty one; further ones are discarded."""
MARKS_AFTER_S: Final = 0.0005
"""Pause between an answer and its marks: computed at once they would take 0.15 ms from the running answer."""
REPLIES: Final = "inproc://replies"

Send: TypeAlias = Callable[[bytes | memoryview], None]
"""Sends one message to the client of a request."""


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
        self._room = Semaphore(limits.waiting + READING)
        self._stopped = Event()
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        self._router.linger = 0
        self._router.rcvhwm = self._router.sndhwm = QUEUED
        self._router.ipv6 = ":" in host
        self._router.maxmsgsize = limits.body_bytes
        self._router.handshake_ivl = round(limits.head_s * 1e3)
        self._router.router_handover = True  # a client that comes again takes its place
        # with a domain libzmq refuses peers of ZMTP 1 and 2 (before 2013), for which any bytes are a greeting: it reads
        # no further where two have one name, and aborts where one floods and HEARTBEAT_IVL is set
        self._router.zap_domain = b"s2a"
        try:
            self._router.bind(f"tcp://{in_url(host)}:{'*' if port == '0' else port}")
        except zmq.ZMQError as error:
            self._context.destroy(0)
            raise cannot_bind(host, port, error.errno, error.strerror) from error
        self.address: str = self._router.get_string(zmq.LAST_ENDPOINT)
        self._finished, self._replies = self._context.socket(zmq.PULL), self._context.socket(zmq.PUSH)
        self._finished.rcvhwm = self._replies.sndhwm = 0  # requests under way bound them
        self._finished.bind(REPLIES)
        self._replies.connect(REPLIES)
        self._poller = zmq.Poller()
        self._poller.register(self._router, zmq.POLLIN)
        self._poller.register(self._finished, zmq.POLLIN)
        self._receiving, self._sending = Lock(), Lock()

    def describe(self) -> dict[str, str | int]:
        return {"server": "pyzmq", "version": zmq.pyzmq_version(), "libzmq": zmq.zmq_version()}

    def serve(self) -> None:
        SharedSourceWorkers(self._next, self._stopped).start()
        self._stopped.wait()
        with self._receiving, self._sending:
            self._context.destroy(0)

    def stop(self) -> None:
        self._stopped.set()

    def _next(self) -> Callable[[], None] | None:
        """Wait; send the first finished reply, else receive the first request and return what answers it."""
        with self._receiving:
            if self._stopped.is_set():
                return None
            ready = dict(self._poller.poll(POLL_MS))
            if self._finished in ready:
                self._router.send_multipart(self._finished.recv_multipart())
                return None
            if self._router not in ready:
                return None
            frames = [self._router.recv(copy=False)]
            while frames[-1].more:
                frames = [*frames[:ENVELOPE], self._router.recv(copy=False)]
        trace = Trace()
        trace.mark("network")
        return self._taken(frames, trace)

    def _taken(self, frames: list[Any], trace: Trace) -> Callable[[], None] | None:
        """Return the job that answers a message: its last frame, behind the envelope that goes back with the reply."""
        send = partial(self._reply, [frame.bytes for frame in frames[:-1]])
        with ExitStack() as held:
            try:
                held.enter_context(self._core.in_flight.counted())(sum(map(len, frames)))
                if not self._room.acquire(blocking=False):
                    raise Busy("too many requests are under way; come again later", retry_after_s=RETRY_AFTER_S)
            except RequestFailed as error:
                send(_error(error))
                return None
            held.callback(self._room.release)
            return partial(self._serve, send, frames[-1], trace, held.pop_all())

    def _serve(self, send: Send, frame: Any, trace: Trace, held: ExitStack) -> None:
        with held:
            try:
                message, marks = read(frame.buffer)
                trace.mark("msgpack_parse")
                self._check(message)
                endpoint = message.get(layouts.ENDPOINT, layouts.GET_ACTION)
                if endpoint == layouts.GET_ACTION:
                    maps = layouts.marked(marks) == layouts.N1_7
                    self._core.answer(ZmqExchange(send, message, trace, self._core.limits, maps=maps))
                else:
                    send(pack(self._reply_of(endpoint)))
            except Exception as error:  # noqa: BLE001 - the client must hear of it, whatever broke
                send(_error(client_error(error)))

    def _check(self, message: Any) -> None:
        """Raise RequestFailed for a malformed message, or one without the key, compared in constant time."""
        if not isinstance(message, dict):
            raise RequestFailed(f"a request is a map, not {type(message).__name__}")
        value = message.get(layouts.TOKEN)
        token = value.encode(errors="replace") if isinstance(value, str) else b""
        if self._key and not hmac.compare_digest(token, self._key):
            raise RequestFailed(f"Unauthorized: this server wants its key as {layouts.TOKEN}")

    def _reply_of(self, endpoint: Any) -> Any:
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
        endpoints = f"{layouts.GET_ACTION}, {layouts.PING}, {layouts.RESET}, {layouts.MODALITIES}"
        raise RequestFailed(f"Unknown endpoint: {str(endpoint)[:80]!r} is not one of {endpoints}")

    def _reply(self, envelope: list[bytes], message: bytes | memoryview) -> None:
        """Have the thread that has the ROUTER send a message."""
        with self._sending:
            if not self._replies.closed:
                self._replies.send_multipart([*envelope, message])


class ZmqExchange(observed.ActionsExchange):
    def __init__(self, send: Send, message: dict[Any, Any], trace: Trace, limits: Limits, *, maps: bool) -> None:
        """Answer ``message``, with arrays as ``maps`` of msgpack-numpy if it has such."""
        super().__init__(trace)
        self._send, self._message, self._limits, self._maps = send, message, limits, maps

    def request(self) -> Request:
        self._extension = observed.take_extension(self._message)
        self._observation, self._layout = layouts.observation_in(self._message.get(layouts.DATA))
        return observed.request_of(self._observation, self._extension, self.trace, self._limits)

    def end(self) -> None:
        """Send the chunk, and behind it the marks if the client is ours, which has sent an extension."""
        answer = layouts.answer_of(self._observation, self._layout, self.chunk())
        self.sent_whole()
        self._send(pack(answer, maps=self._maps))
        if self._extension is not None:
            sleep(MARKS_AFTER_S)
            self._send(pack(self.marks()))

    def fail(self, error: S2AError) -> None:
        self._send(_error(error))


def _error(error: S2AError) -> memoryview:
    retry_s = error.retry_after_s if isinstance(error, RequestFailed) else None
    reply = {layouts.ERROR: str(error) or type(error).__name__}
    return pack({**reply, layouts.RETRY: retry_s} if retry_s else reply)


def _resolved(host: str) -> str:
    """Return the address of a host, for libzmq binds no names."""
    try:
        return host if ":" in host else socket.gethostbyname(host)
    except OSError as error:
        raise TransportError(f"`host`: '{host}' is not an address of this machine: {error}") from error
