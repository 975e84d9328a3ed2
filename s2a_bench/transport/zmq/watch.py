"""What libzmq does not bound, bounded from outside: who is connected, and how much of it waits for its rest.

ZMQ_MAXMSGSIZE is for one frame, but a message may have any number of frames, and libzmq keeps all of them until the
last has come; nor does it count connections. So its monitor tells of every connection, the kernel how many bytes came
over it (TCP_INFO), and the messages how many of them were for us; who sent more is shut down.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, Final

import zmq

from s2a_bench.transport.limits import Limits

LINUX: Final = sys.platform == "linux"
TCP_INFO: Final = 11
RECEIVED: Final = struct.Struct("=128xQ")
"""``tcpi_bytes_received`` in Linux's struct tcp_info, 4.1 and later."""
EVENT: Final = struct.Struct("=HI")
"""The first frame of what a monitor says."""
LONG: Final = 256
"""From this many bytes on a frame's length takes 8 bytes, below 1 (ZMTP 3.1, 3.2)."""
ROOM: Final = 1 << 20
"""Bytes for greetings, heartbeats, and what is on its way when a connection is looked at."""
BEGUN: Final = {zmq.EVENT_ACCEPTED, zmq.EVENT_CONNECTED}
REFUSED: Final = {zmq.EVENT_CONNECT_RETRIED, zmq.EVENT_CLOSED}


class Connection:
    """One TCP connection of a ZeroMQ socket."""

    __slots__ = ("_socket", "_taken", "begun_ns", "gone", "held", "ready")

    def __init__(self, descriptor: int) -> None:
        """Look at the connection that libzmq has under this descriptor."""
        self.gone = False
        self.ready = False
        """Whether both sides have greeted."""
        self.held = 0
        """Bytes of messages that are not complete, when it was looked at last."""
        self.begun_ns = 0
        """When the first of them was seen; 0 where there are none."""
        self._taken = 0
        self._socket: socket.socket | None = None
        with suppress(OSError):  # it may have ended already
            self._socket = socket.socket(fileno=os.dup(descriptor))

    def take(self, sizes: Iterable[int]) -> None:
        """Count the frames of a message that is complete."""
        self._taken += sum(size + (2 if size < LONG else 9) for size in sizes)
        self.begun_ns = 0

    def look(self) -> int:
        """Return how many bytes came that are in no complete message; 0 where the kernel does not tell."""
        told = b""
        with suppress(OSError):
            told = self._socket.getsockopt(socket.IPPROTO_TCP, TCP_INFO, 256) if self._socket and LINUX else b""
        self.held = max(0, RECEIVED.unpack_from(told)[0] - self._taken) if len(told) >= RECEIVED.size else 0
        return self.held

    def shut(self) -> None:
        """Break it; libzmq notices, and forgets what came."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def end(self) -> None:
        """Let go of it."""
        self.gone = True
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Watch:
    """The connections of one socket; for the thread that has the socket."""

    def __init__(self, watched: Any) -> None:
        """Watch a socket that neither connects nor is bound yet."""
        self.connections: dict[int, Connection] = {}
        """By libzmq's descriptor."""
        self.met = self.refused = False
        """Whether a connection has begun; whether one was refused."""
        self.monitor = watched.get_monitor_socket()
        self._watched = watched

    def hear(self) -> list[Connection]:
        """Take note of what has happened; return the connections that are new."""
        new = []
        while self.monitor.getsockopt(zmq.EVENTS) & int(zmq.POLLIN):
            event, value = EVENT.unpack(self.monitor.recv_multipart()[0])
            if event in BEGUN:
                self.met = True
                self._end(value)
                self.connections[value] = connection = Connection(value)
                new.append(connection)
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                for connection in self.connections.values():
                    connection.ready = True
            elif event == zmq.EVENT_DISCONNECTED:
                self._end(value)
            elif event in REFUSED:
                self.refused = True
        return new

    def of(self, descriptor: int) -> Connection:
        """Return the connection that a message came over.

        What happened before comes first: the same descriptor may have been that of another connection, which is gone.
        """
        self.hear()
        return self.connections.get(descriptor) or self.connections.setdefault(descriptor, Connection(descriptor))

    def keep(self, limits: Limits, in_flight: int, at_ns: int) -> int:
        """Shut the connections down that go beyond a server's limits; ``in_flight`` bytes wait for their answer.

        Returns how many bytes are held, those included.
        """
        for connection in list(self.connections.values())[limits.connections :]:
            connection.shut()
        for connection in self.connections.values():
            in_flight += connection.look()
            if connection.held > ROOM:
                connection.begun_ns = connection.begun_ns or at_ns
            late = connection.begun_ns and at_ns - connection.begun_ns > limits.body_s * 1e9
            if late or connection.held > limits.body_bytes + ROOM:
                connection.shut()
        if in_flight > limits.in_flight_bytes + ROOM and self.connections:
            max(self.connections.values(), key=lambda connection: connection.held).shut()
        return in_flight

    def close(self) -> None:
        """Stop watching."""
        for descriptor in list(self.connections):
            self._end(descriptor)
        with suppress(zmq.ZMQError):
            self._watched.disable_monitor()
        self.monitor.close(0)

    def _end(self, descriptor: int) -> None:
        if (connection := self.connections.pop(descriptor, None)) is not None:
            connection.end()
