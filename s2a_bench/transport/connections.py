"""Connections of a server: one thread each, up to a limit; a read may end after a silence, and a write never waits.

The scheduler shares the processor among the threads: a client that floods its connection delays the others less than
on an event loop.
"""

from __future__ import annotations

import logging
import select
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Lock, Thread
from typing import Final

from s2a_bench.clock import now_ns
from s2a_bench.transport.serving import Disconnected

GRACE_S: Final = 1.0
"""Time for running answers when a server is stopped."""
LINGER_S: Final = 1.0
"""Time for a client to read a refusal: closing at once would reset the connection; one too many is closed at once."""
PAUSE_S: Final = 0.1
"""Pause after a failed accept: the limit of open files or threads is reached."""
_TIMEVAL: Final = struct.Struct("@ll")
_log = logging.getLogger(__name__)


class Connections:
    """Handles up to ``most`` connections of a socket at once, each on a thread; others receive ``refusal``."""

    def __init__(self, listener: socket.socket, handle: Callable[[Wire], None], most: int, refusal: bytes) -> None:
        self._listener, self._handle, self._most, self._refusal = listener, handle, most, refusal
        self._lock = Lock()
        self._wires: dict[Wire, Thread] = {}
        self._stopped = False

    def serve(self) -> None:
        """Accept until `stop`; then wait up to `GRACE_S` for running answers, and hang up."""
        while not self._stopped:
            try:
                accepted, _ = self._listener.accept()
                self._take(accepted)
            except (OSError, RuntimeError) as error:
                if not self._stopped:
                    _log.warning("no connection can be accepted: %s", error)
                    time.sleep(PAUSE_S)
        ends = time.monotonic() + GRACE_S
        for thread in list(self._wires.values()):
            thread.join(max(0.0, ends - time.monotonic()))
        for wire in list(self._wires):
            wire.hang_up()

    def stop(self) -> None:
        self._stopped = True
        with suppress(OSError):  # wakes a blocked `accept`, which closing alone does not
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for wire in list(self._wires):
            wire.read_no_more()

    def _take(self, accepted: socket.socket) -> None:
        if len(self._wires) >= self._most:
            with suppress(OSError), accepted:
                accepted.send(self._refusal, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            return
        wire = Wire(accepted)
        thread = Thread(target=self._handled, args=(wire,), name="connection", daemon=True)
        with self._lock:
            self._wires[wire] = thread
        try:
            thread.start()
        except RuntimeError:  # the limit of threads is reached
            self._close(wire)
            raise
        if self._stopped:  # `stop` may have gone through the connections before this one was among them
            wire.read_no_more()

    def _handled(self, wire: Wire) -> None:
        try:
            self._handle(wire)
        except (OSError, EOFError, Disconnected):
            pass  # the client has disconnected
        except Exception as error:  # noqa: BLE001 - the others go on
            _log.error("a connection failed", exc_info=error)
        finally:
            self._close(wire)

    def _close(self, wire: Wire) -> None:
        with self._lock:
            self._wires.pop(wire, None)
        wire.socket.close()


class Wire:
    """One accepted connection, which is read from its socket; writes never wait for a slow client."""

    def __init__(self, accepted: socket.socket) -> None:
        self.socket = accepted
        self._poll = select.poll()
        self._poll.register(accepted, select.POLLRDHUP)
        self._unsent = bytearray()
        self._stopping = False

    def sendall(self, data: bytes | memoryview) -> None:
        """Send what the client takes at once; the rest follows with the next call or `flush`. Raises Disconnected."""
        unsent = self._unsent
        if unsent:
            unsent += data
        try:
            sent = self.socket.send(unsent or data, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise Disconnected from error
        if unsent:
            del unsent[:sent]
        else:
            unsent += memoryview(data)[sent:]  # a view: a slice of bytes would be a copy

    def flush(self, left_s: float) -> None:
        """Send the rest, and wait for the client up to this time; raises Disconnected."""
        ends_ns = now_ns() + round(left_s * 1e9)
        writable = select.poll()
        while self._unsent:
            writable.register(self.socket, select.POLLOUT)
            if not writable.poll(max(0, ends_ns - now_ns()) / 1e6):
                raise Disconnected("the client does not read its answer")
            self.sendall(b"")

    def disconnected(self) -> bool:
        """Whether the client has hung up, even if some of its bytes are unread."""
        # our own SHUT_RD raises POLLRDHUP too, so after `read_no_more` the poll says nothing
        return not self._stopping and bool(self._poll.poll(0))

    def linger(self) -> None:
        """Close for writing, and discard what still arrives within `LINGER_S`."""
        with suppress(OSError, Disconnected):
            self.flush(LINGER_S)
            self.socket.shutdown(socket.SHUT_WR)
            wait_at_most(self.socket, LINGER_S)
            ends_ns = now_ns() + round(LINGER_S * 1e9)
            while now_ns() < ends_ns and self.socket.recv(1 << 18):
                pass

    def read_no_more(self) -> None:
        """End reads; a running answer may still be written."""
        self._stopping = True
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)

    def hang_up(self) -> None:
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)


def wait_at_most(connection: socket.socket, seconds: float) -> None:
    """Let blocking calls raise BlockingIOError after this time, 0: never; `settimeout` would cost a poll for each."""
    value = timeval(seconds)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)


def timeval(seconds: float) -> bytes:
    """Return a time as options of sockets have it."""
    whole = int(seconds)  # at least 1 us below: an option of zero would mean no limit
    return _TIMEVAL.pack(whole, max(int((seconds - whole) * 1e6), int(seconds > 0 and not whole)))
