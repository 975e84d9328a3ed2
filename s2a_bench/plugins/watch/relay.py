"""The relay: two blocking threads a connection, which pass bytes on at once and then show a copy to the reader."""

from __future__ import annotations

import select
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import Final

from s2a_bench.clock import now_ns
from s2a_bench.transport.connections import Connections, Wire
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.tap import Reader, Seen, Turns

PART_BYTES: Final = 1 << 18
"""Most bytes that are read at once."""
MOST_HELD: Final = 64
"""Parts that wait for one that is not passed on yet, as its receiver does not read; the reader then goes on."""
CONNECT_S: Final = 10.0


@dataclass(slots=True, eq=False)
class Client:
    """One client of the server, from connection to connection."""

    number: int
    host: str


@dataclass(slots=True)
class Totals:
    connections: int = 0
    reconnects: int = 0
    unreachable: int = 0
    """Connections for which the server was not there."""
    unread: int = 0
    """Connections that went on by who speaks, as their reader failed."""
    pings: int = 0
    up_bytes: int = 0
    down_bytes: int = 0


@dataclass(eq=False)
class Relay:
    """Passes connections of ``listener`` on to a server, each read by a reader of its own.

    ``reader`` makes one of ``tell`` and the known kinds. ``tell`` is called with the number of a client and each of its
    exchanges, on the threads of connections, ``say`` with a line where something is wrong.
    """

    listener: socket.socket
    server: tuple[str, int]
    reader: Callable[[Callable[[Seen], None], set[str]], Reader]
    tell: Callable[[int, Seen], None]
    say: Callable[[str], None]
    totals: Totals = field(default_factory=Totals)

    def __post_init__(self) -> None:
        self._lock = Lock()
        self._clients: list[Client] = []
        self._left: dict[str, list[Client]] = {}
        self._known: set[str] = set()
        self._said: set[str] = set()
        self._connections = Connections(self.listener, self._handle, LIMITS.connections, b"")

    def serve(self) -> None:
        """Relay until `stop`."""
        self._connections.serve()

    def stop(self) -> None:
        self._connections.stop()

    def _handle(self, wire: Wire) -> None:
        client = self._client_at(wire.socket.getpeername()[0])
        try:
            with socket.create_connection(self.server, CONNECT_S) as server:
                server.settimeout(None)
                self._join(client, wire.socket, server)
        except OSError as error:
            self.totals.unreachable += 1
            self._once(f"nothing answers at {self.server[0]}:{self.server[1]}: {error}; connections are closed")
        finally:
            with self._lock:
                self._left.setdefault(client.host, []).append(client)

    def _client_at(self, host: str) -> Client:
        """Return who connects: the client of this host that left last, else a new one."""
        with self._lock:
            self.totals.connections += 1
            if left := self._left.get(host):
                self.totals.reconnects += 1
                return left.pop()
            self._clients.append(Client(len(self._clients), host))
            return self._clients[-1]

    def _join(self, client: Client, robot: socket.socket, server: socket.socket) -> None:
        for each in (robot, server):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        passed = Passed(self.reader(lambda seen: self.tell(client.number, seen), self._known), self._failed)
        down = Thread(target=_pass, args=(server, robot, passed), kwargs={"up": False}, name="down", daemon=True)
        down.start()
        _pass(robot, server, passed, up=True)
        down.join()
        passed.end()
        with self._lock:
            self.totals.pings += passed.reader.pings
            self.totals.up_bytes += passed.bytes[True]
            self.totals.down_bytes += passed.bytes[False]

    def _failed(self, error: Exception) -> None:
        with self._lock:
            self.totals.unread += 1
        self._once(f"what passes is not what was expected ({error}); such connections are read by who speaks")

    def _once(self, line: str) -> None:
        with self._lock:
            if line in self._said or len(self._said) >= MOST_HELD:
                return
            self._said.add(line)
        self.say(line)


@dataclass(slots=True, eq=False)
class Part:
    """Bytes that arrived together."""

    up: bool
    data: bytes
    from_ns: int
    to_ns: int = 0
    """When they had been passed on; 0: not yet."""


class Passed:
    """Shows a reader what passed in both directions in order of arrival, whichever thread is the first to tell."""

    def __init__(self, reader: Reader, failed: Callable[[Exception], None]) -> None:
        self.reader = reader
        self.bytes = {True: 0, False: 0}
        self._failed = failed
        self._lock = Lock()
        self._parts = deque[Part]()

    def arrived(self, data: bytes, *, up: bool) -> Part:
        part = Part(up, data, now_ns())
        self._parts.append(part)
        return part

    @property
    def full(self) -> bool:
        return len(self._parts) > MOST_HELD

    @property
    def _ready(self) -> bool:
        return bool(self._parts) and (self._parts[0].to_ns > 0 or self.full)

    def read(self) -> None:
        """Read what has been passed on, up to a part that has not been; nobody waits for a thread that reads."""
        while self._ready and self._lock.acquire(blocking=False):
            try:
                while self._ready:
                    self._read(self._parts.popleft())
            finally:
                self._lock.release()

    def _read(self, part: Part) -> None:
        self.bytes[part.up] += len(part.data)
        times = part.from_ns, part.to_ns or part.from_ns
        try:
            self.reader.passed(part.data, *times, up=part.up)
        except Exception as error:  # noqa: BLE001 - no reader's error is the robot's
            self._failed(error)
            self.reader = Turns(self.reader.tell, set())
            self.reader.passed(part.data, *times, up=part.up)

    def end(self) -> None:
        """Read the rest, once both directions have ended."""
        while self._parts:
            self._read(self._parts.popleft())
        with suppress(Exception):
            self.reader.end()


def _pass(source: socket.socket, target: socket.socket, passed: Passed, *, up: bool) -> None:
    """Pass bytes on until one side ends, then end the other: its half, or both if the connection broke.

    They are read while nothing waits to be passed on.
    """
    how, more = socket.SHUT_WR, select.poll()
    more.register(source, select.POLLIN)
    try:
        while data := source.recv(PART_BYTES):
            part = passed.arrived(data, up=up)
            target.sendall(data)
            part.to_ns = now_ns()
            if passed.full or not more.poll(0):
                passed.read()
    except OSError:
        how = socket.SHUT_RDWR
        with suppress(OSError):
            source.shutdown(how)
    with suppress(OSError):
        target.shutdown(how)
