"""Our policy server: GR00T's protocol on a ROUTER socket, so that one request does not block all other clients.

One thread waits for messages; threads of a pool read and answer (`call`). libzmq allows a socket to one thread at a
time, which a lock sees to: whoever answers sends by itself, so that no answer waits for the interpreter to change
threads. So the waiting thread must not ask the socket, and waits for its descriptor, which tells of changes (ZMQ_FD).
"""

from __future__ import annotations

import select
import socket
from contextlib import suppress
from threading import Lock
from typing import Any, Final

import zmq

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, TransportError
from s2a_bench.machine.tuning import give_back_memory
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.credentials import key_for
from s2a_bench.transport.listening import cannot_bind, split
from s2a_bench.transport.turns import Queued
from s2a_bench.transport.zmq.call import Call, Office
from s2a_bench.transport.zmq.options import ZmqOptions
from s2a_bench.transport.zmq.watch import Watch

LOOKS_MS: Final = 20
"""How often connections are looked at: over loopback 60 MB may come meanwhile."""
QUEUED: Final = 8
"""Messages of one client that libzmq keeps for us; those beyond wait in its own machine."""
LARGE_BYTES: Final = 1 << 22
"""From here on memory that was held goes back to the system."""
LINGER_NS: Final = 1_000_000_000
"""How long no more than that is held before it does."""
ENVELOPE: Final = 4
"""Most frames before a message."""


class ZmqServer:
    """A server on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[ZmqOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was, without it 127.0.0.1 and any port.

        Raises PortInUse, and UsageError where others than this machine would need no key and nobody said so.
        """
        told, port = split(wiring.address, "tcp")
        options, self._limits = wiring.options, wiring.limits
        host = _resolved(told)
        key = key_for(host, options.api_key_env, everybody=options.no_auth)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._lock = Lock()
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        self._router.linger = 0
        self._router.rcvhwm = self._router.sndhwm = QUEUED
        self._router.maxmsgsize = self._limits.body_bytes
        self._router.handshake_ivl = round(self._limits.head_s * 1e3)
        self._watch = Watch(self._router)
        try:
            self._router.bind(f"tcp://{host}:{'*' if port == '0' else port}")
        except zmq.ZMQError as error:
            self._close()
            raise cannot_bind(host, port, error.errno, error.strerror) from error
        self.address: str = self._router.get_string(zmq.LAST_ENDPOINT)
        self._office = Office(Queued.around(handler, wiring.limits), wiring.limits, key, options.layout, self._send)
        self._stopped = False
        self._much_ns = 0

    def describe(self) -> dict[str, str | int]:
        """Say what serves."""
        return {"server": "pyzmq", "version": zmq.pyzmq_version(), "libzmq": zmq.zmq_version()}

    def serve(self) -> None:
        """Serve until stopped."""
        poller = select.poll()
        for readable in (self._router.FD, self._woken, self._watch.monitor.FD):
            poller.register(readable, select.POLLIN)
        looked_ns, more = 0, True
        try:
            while not self._stopped:
                busy = self._watch.connections or self._office.calls or self._much_ns
                poller.poll(0 if more else LOOKS_MS if busy else None)
                with suppress(BlockingIOError):
                    self._woken.recv(4096)
                more = self._hear()
                self._watch.hear()
                if (at_ns := now_ns()) - looked_ns > LOOKS_MS * 1e6:
                    looked_ns = at_ns
                    if self._watch.keep(self._limits, self._office.in_flight, at_ns) >= LARGE_BYTES:
                        self._much_ns = at_ns
                    elif self._much_ns and at_ns - self._much_ns > LINGER_NS:
                        self._much_ns = 0
                        give_back_memory()
                    for call in list(self._office.calls):
                        call.look(at_ns)
        finally:
            self._office.threads.shutdown(wait=False, cancel_futures=True)
            self._close()

    def _hear(self) -> bool:
        """Take the messages that are there; return whether there may be more."""
        for _ in range(QUEUED):
            with self._lock:
                try:
                    frames = self._router.recv_multipart(zmq.NOBLOCK, copy=False)
                except zmq.Again:
                    return False
            trace = Trace()
            trace.mark("network")
            self._take(frames, trace)
        return True

    def _take(self, frames: list[Any], trace: Trace) -> None:
        """Have a message answered: one frame, after an envelope that ends with an empty one."""
        try:
            connection = self._watch.of(frames[-1].get(zmq.SRCFD))
        except zmq.ZMQError:
            return  # before ZMTP 3 (2013) messages do not tell where they are from; so does noise that looks like it
        sizes = [len(frame) for frame in frames[1:]]
        connection.take(sizes)
        if len(frames) > ENVELOPE or len(frames) < 3 or sizes[-2]:  # noqa: PLR2004 - identity, empty, message
            return  # no REQ socket sent this, so that nobody waits for an answer
        envelope = [frame.bytes for frame in frames[:-1]]
        size = sizes[-1]
        if size >= LARGE_BYTES:
            self._much_ns = trace.marks[0][1]
        try:
            self._office.refuse_more(size)
        except Busy as error:
            Call(self._office, envelope, connection, 0).refuse(error)
            return
        Call(self._office, envelope, connection, size).start(frames[-1].buffer, trace)

    def _send(self, frames: list[Any]) -> None:
        """Send an answer, from any thread."""
        with self._lock:
            if self._router.closed:
                return
            with suppress(zmq.ZMQError):  # who asked has gone, or does not read
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

    def stop(self) -> None:
        """Break off what is under way."""
        self._stopped = True
        self._rouse()


def _resolved(host: str) -> str:
    """Return the address of a host, for libzmq binds no names."""
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise TransportError(f"`host`: '{host}' is no address of this machine: {error}") from error
