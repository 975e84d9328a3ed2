"""What a connection of our server sends, from any thread: into the socket at once, as long as the client reads as fast.

What the socket does not take goes through the event loop, and all that follows behind it, so that the order stays.
"""

from __future__ import annotations

import os
import socket
from asyncio import AbstractEventLoop, Transport
from contextlib import suppress
from threading import Lock
from typing import Final

POLL_S: Final = 0.005
"""How often it is looked whether the client has read what it was sent."""


class Outlet:
    """The sending side of one connection."""

    def __init__(self, transport: Transport, loop: AbstractEventLoop) -> None:
        """Write to the socket of ``transport``, and close it with `close`."""
        self._transport, self._loop = transport, loop
        self._socket = socket.socket(fileno=os.dup(transport.get_extra_info("socket").fileno()))
        self._lock = Lock()
        self._rest = bytearray()
        self._behind = self._scheduled = False

    def send(self, data: bytes) -> None:
        """Write on this thread, without waiting."""
        with self._lock:
            if not self._behind:
                try:
                    sent = self._socket.send(data, socket.MSG_DONTWAIT)
                except BlockingIOError:
                    sent = 0
                except OSError:
                    return  # it has gone, and the loop hears of it
                data = data[sent:]
            if not data:
                return
            self._behind = True
            self._rest += data
            if not self._scheduled:
                self._scheduled = True
                with suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        """Send nothing any more."""
        self._socket.close()

    def _drain(self) -> None:
        """Hand over what is left; once the client has read all of it, threads write themselves again."""
        with self._lock:
            data, self._rest = bytes(self._rest), bytearray()
            self._scheduled = False
        if self._transport.is_closing():
            return
        if data:
            self._transport.write(data)
        with self._lock:
            self._behind = bool(self._rest) or self._transport.get_write_buffer_size() > 0
            if self._behind and not self._scheduled:
                self._scheduled = True
                self._loop.call_later(POLL_S, self._drain)
