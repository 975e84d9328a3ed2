"""The relay: two blocking threads a connection, which pass bytes on at once and then show a copy to the reader."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Lock, Thread, current_thread
from typing import Final

from s2a_bench.clock import now_ns
from s2a_bench.transport.connections import Connections, Wire
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.tap import Seen, TapReader, TurnsReader

PART_BYTES: Final = 1 << 19
"""Most bytes that are read at once."""
MOST_HELD: Final = 16
"""Parts that wait for one that is not passed on yet, as its receiver does not read; the reader then goes on."""
CONNECT_S: Final = 10.0


@dataclass(slots=True, eq=False)
class TappedClient:
    """One client of the server, from connection to connection."""

    number: int
    host: str
    wire: Wire | None = None
    """The present connection; None between two."""


@dataclass(slots=True)
class Totals:
    connections: int = 0
    reconnects: int = 0
    """Connections of a client that had one before."""
    unreachable: int = 0
    """Connections for which the server was not there."""
    unread: int = 0
    """Connections read by turns, as their reader failed."""
    pings: int = 0


@dataclass(eq=False)
class ByteRelay:
    """Passes connections of ``listener`` on to a server, each read by a reader of its own.

    ``reader`` makes one of ``report`` and the known kinds. ``report`` is called with the number of a client and each of
    its exchanges, on the threads of connections, ``say`` with a line where something is wrong.
    """

    listener: socket.socket
    server: tuple[str, int]
    reader: Callable[[Callable[[Seen], None], set[str]], TapReader]
    report: Callable[[int, Seen], None]
    say: Callable[[str], None]
    totals: Totals = field(default_factory=Totals)

    def __post_init__(self) -> None:
        self._lock = Lock()
        self._clients: list[TappedClient] = []
        self._joined: dict[socket.socket, Thread] = {}
        self._kinds: set[str] = set()
        self._lines: set[str] = set()
        self._connections = Connections(self.listener, self._handle, LIMITS.connections, b"")

    def serve(self) -> None:
        """Relay until `stop`; then connections are ended, and what passed is read to its end."""
        self._connections.serve()
        for server, thread in list(self._joined.items()):
            with suppress(OSError):
                server.shutdown(socket.SHUT_RDWR)
            thread.join()

    def stop(self) -> None:
        self._connections.stop()

    def _handle(self, wire: Wire) -> None:
        client, server = self._client_of(wire), None
        try:
            server = socket.create_connection(self.server, CONNECT_S)
            server.settimeout(None)  # that of the connect would end silent connections
            self._joined[server] = current_thread()
            self._join(client, wire.socket, server)
        except OSError as error:
            self.totals.unreachable += 1
            self._once(f"nothing answers at {self.server[0]}:{self.server[1]}: {error}; connections are closed")
        finally:
            client.wire = None if client.wire is wire else client.wire
            if server:
                del self._joined[server]
                server.close()

    def _client_of(self, wire: Wire) -> TappedClient:
        """Return the client that connects: one of that host whose connection has ended, else a new one."""
        host = wire.socket.getpeername()[0]
        with self._lock:
            self.totals.connections += 1
            for client in self._clients:
                if client.host == host and (client.wire is None or client.wire.disconnected()):
                    self.totals.reconnects += 1
                    break
            else:
                client = TappedClient(len(self._clients), host)
                self._clients.append(client)
            client.wire = wire
            return client

    def _join(self, client: TappedClient, robot: socket.socket, server: socket.socket) -> None:
        for each in (robot, server):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # the relay itself must hold nothing back
        passed = Passed(self.reader(lambda seen: self.report(client.number, seen), self._kinds), self._failed)
        down = Thread(target=_pass, args=(server, robot, passed), kwargs={"up": False}, name="down", daemon=True)
        down.start()
        _pass(robot, server, passed, up=True)
        down.join()
        passed.end()
        with self._lock:
            self.totals.pings += passed.reader.pings

    def _failed(self, error: Exception) -> None:
        self.totals.unread += 1
        self._once(f"what passes is not what was expected ({error}); such connections are read by turns")

    def _once(self, line: str) -> None:
        if line not in self._lines and len(self._lines) < MOST_HELD:
            self._lines.add(line)
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
    """Shows a reader what passed in both directions, in order of arrival."""

    def __init__(self, reader: TapReader, failed: Callable[[Exception], None]) -> None:
        self.reader = reader
        self._failed = failed
        self._lock = Lock()
        self._parts = deque[Part]()

    def arrived(self, data: bytes, *, up: bool) -> Part:
        part = Part(up, data, now_ns())
        self._parts.append(part)
        return part

    def read(self) -> None:
        """Read the parts that have been passed on, up to one that has not been yet, perhaps the request before them."""
        with self._lock:
            while self._parts and (self._parts[0].to_ns or len(self._parts) > MOST_HELD):
                self._read(self._parts.popleft())

    def end(self) -> None:
        """Read the rest, once both directions have ended."""
        while self._parts:
            self._read(self._parts.popleft())
        with suppress(Exception):
            self.reader.end()

    def _read(self, part: Part) -> None:
        times = part.from_ns, part.to_ns or part.from_ns
        try:
            self.reader.passed(part.data, *times, up=part.up)
        except Exception as error:  # noqa: BLE001 - no reader's error is the robot's
            self._failed(error)
            self.reader = TurnsReader(self.reader.report, set())
            self.reader.passed(part.data, *times, up=part.up)


def _pass(source: socket.socket, target: socket.socket, passed: Passed, *, up: bool) -> None:
    """Pass bytes on until one side ends, then end the other: its half, or both if the connection broke."""
    how = socket.SHUT_WR
    try:
        while data := source.recv(PART_BYTES):
            part = passed.arrived(data, up=up)
            target.sendall(data)
            part.to_ns = now_ns()
            passed.read()
    except OSError:
        how = socket.SHUT_RDWR
        with suppress(OSError):  # it may be closed already
            source.shutdown(how)
    with suppress(OSError):
        target.shutdown(how)
