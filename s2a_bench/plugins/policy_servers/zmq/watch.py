"""The connections of a ZeroMQ socket, from its monitor: which have ended, and how many there are."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import zmq
from zmq.utils.monitor import parse_monitor_message

BEGUN: Final = {zmq.EVENT_ACCEPTED, zmq.EVENT_CONNECTED}
REFUSED: Final = {zmq.EVENT_CONNECT_RETRIED, zmq.EVENT_CLOSED}


@dataclass(slots=True, eq=False)
class Connection:
    disconnected: bool = False
    ready: bool = False
    """Whether both sides have greeted."""


class ConnectionWatch:
    """The connections of one socket; for the thread that has the socket."""

    def __init__(self, watched: Any) -> None:
        self.connections: dict[int, Connection] = {}
        """By libzmq's descriptor."""
        self.met = self.refused = False
        """Whether a connection has begun; whether one was refused."""
        self.monitor = watched.get_monitor_socket()
        self._watched = watched

    def hear(self) -> None:
        while self.monitor.getsockopt(zmq.EVENTS) & int(zmq.POLLIN):
            message = parse_monitor_message(self.monitor.recv_multipart())
            event, value = message["event"], message["value"]
            if event in BEGUN:
                self.met = True
                self._end(value)
                self.connections[value] = Connection()
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                for connection in self.connections.values():
                    connection.ready = True
            elif event == zmq.EVENT_DISCONNECTED:
                self._end(value)
            elif event in REFUSED:
                self.refused = True

    def of(self, descriptor: int) -> Connection:
        """Return the connection that a message came over.

        What happened before comes first: the same descriptor may have been that of another connection, which has ended.
        """
        self.hear()
        return self.connections.get(descriptor) or Connection()  # one that has ended meanwhile is not counted

    def keep(self, most: int) -> None:
        """Break connections beyond so many, the latest; libzmq notices, and forgets what came."""
        for descriptor in list(self.connections)[most:]:
            with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as connection:
                if connection.family in {socket.AF_INET, socket.AF_INET6}:  # or another socket has it by now
                    connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        for descriptor in list(self.connections):
            self._end(descriptor)
        with suppress(zmq.ZMQError):
            self._watched.disable_monitor()
        self.monitor.close(0)

    def _end(self, descriptor: int) -> None:
        if (connection := self.connections.pop(descriptor, None)) is not None:
            connection.disconnected = True
