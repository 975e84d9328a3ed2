"""Connections of a server: a thread for each, at most so many; reads have a deadline, and writes never wait.

The scheduler shares the processor out among threads: a client that floods its connection delays the others less than
it could on an event loop. docs/reliability.md has the figures.
"""

from __future__ import annotations

import logging
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Lock, Thread
from typing import Final

from s2a_bench.clock import now_ns
from s2a_bench.transport.serving import Disconnected

GRACE_S: Final = 1.0
"""Time for the answers under way when a server is stopped."""
LINGER_S: Final = 1.0
"""Time for a client to read a refusal: closing at once would reset the connection under it."""
LINGERING: Final = 1024
"""Refused connections that are kept open for so long, at most."""
PAUSE_S: Final = 0.1
"""Before the next connection is taken, where one could not be: the limit of open files, or of threads, is met."""
GONE: Final = select.POLLRDHUP | select.POLLHUP | select.POLLERR
_TIMEVAL: Final = struct.Struct("@ll")
_log = logging.getLogger(__name__)


class Connections:
    """The connections of one listening socket."""

    def __init__(
        self, listener: socket.socket, handle: Callable[[Wire], None], most: int, refusal: bytes = b""
    ) -> None:
        """Have each of at most ``most`` connections at once handled on a thread; others are sent ``refusal``."""
        self._listener, self._handle, self._most, self._refusal = listener, handle, most, refusal
        self._lock = Lock()
        self._wires: dict[Wire, Thread] = {}
        self._refused: deque[tuple[float, socket.socket]] = deque()
        self._stopped = False

    def serve(self) -> None:
        """Accept until `stop`; then wait for the answers under way, for `GRACE_S` at most, and hang up."""
        while not self._stopped:
            try:
                accepted, _ = self._listener.accept()
                self._take(accepted)
            except (OSError, RuntimeError) as error:
                if not self._stopped:
                    _log.warning("no connection can be taken: %s", error)
                    time.sleep(PAUSE_S)
            self._forget()
        ends = time.monotonic() + GRACE_S
        for thread in list(self._wires.values()):
            thread.join(max(0.0, ends - time.monotonic()))
        for wire in list(self._wires):
            wire.hang_up()

    def stop(self) -> None:
        """Make `serve` return soon; may be called twice, from any thread."""
        self._stopped = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for wire in list(self._wires):
            wire.read_no_more()

    def _take(self, accepted: socket.socket) -> None:
        if len(self._wires) >= self._most:
            with suppress(OSError):
                accepted.send(self._refusal, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
                accepted.shutdown(socket.SHUT_WR)
            self._refused.append((time.monotonic(), accepted))
            return
        wire = Wire(accepted)
        thread = Thread(target=self._handled, args=(wire,), name="connection", daemon=True)
        with self._lock:
            self._wires[wire] = thread
        try:
            thread.start()
        except RuntimeError:
            self._close(wire)
            raise
        if self._stopped:
            wire.read_no_more()

    def _handled(self, wire: Wire) -> None:
        try:
            self._handle(wire)
        except (OSError, EOFError, Disconnected):
            pass  # the client has gone
        except Exception as error:  # noqa: BLE001 - the others go on
            _log.error("a connection failed", exc_info=error)
        finally:
            self._close(wire)

    def _close(self, wire: Wire) -> None:
        with self._lock:
            self._wires.pop(wire, None)
        wire.close()

    def _forget(self) -> None:
        """Close refused connections whose time is over."""
        while self._refused and (
            len(self._refused) > LINGERING or self._stopped or time.monotonic() - self._refused[0][0] > LINGER_S
        ):
            self._refused.popleft()[1].close()


class Wire:
    """One accepted connection. Its client may be slow, or flood it: reads have a deadline, and writes never wait."""

    def __init__(self, accepted: socket.socket) -> None:
        """Read and write this socket."""
        self.socket = accepted
        self._poll = select.poll()
        self._poll.register(accepted, select.POLLRDHUP)
        self._ends_ns = 0
        self._late = bytearray()
        self._stopping = False

    def read_until(self, ends_ns: int) -> None:
        """Let reads raise TimeoutError from here on, in nanoseconds of CLOCK_MONOTONIC; 0: never."""
        self._ends_ns = ends_ns
        if not ends_ns:
            wait_at_most(self.socket, 0)

    def recv(self, size: int) -> bytes:
        """Wait for bytes; none where the client, or this server, has closed. Raises OSError."""
        with self._in_time():
            return self.socket.recv(size)

    def recv_into(self, room: memoryview) -> int:
        """Wait for bytes; 0 where the client, or this server, has closed. Raises OSError."""
        with self._in_time():
            return self.socket.recv_into(room)

    @contextmanager
    def _in_time(self) -> Iterator[None]:
        """Bound what the kernel waits for: the socket itself always blocks, or `sendall` would wait, too."""
        if self._ends_ns:
            left_ns = self._ends_ns - now_ns()
            if left_ns <= 0:
                raise TimeoutError
            wait_at_most(self.socket, left_ns / 1e9)
        try:
            yield
        except BlockingIOError:
            raise TimeoutError from None

    def sendall(self, data: bytes | memoryview) -> None:
        """Send what the client takes at once; the rest goes with what follows, or by `flush`. Raises Disconnected."""
        late = self._late
        if late:
            late += data
        try:
            sent = self.socket.send(late or data, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise Disconnected from error
        if late:
            del late[:sent]
        else:
            late += memoryview(data)[sent:]

    def flush(self, left_s: float) -> None:
        """Send the rest, waiting for the client for so long; raises Disconnected."""
        ends_ns = now_ns() + round(left_s * 1e9)
        writable = select.poll()
        while self._late:
            writable.register(self.socket, select.POLLOUT)
            if not writable.poll(max(0, ends_ns - now_ns()) / 1e6):
                raise Disconnected("the client does not read its answer")
            self.sendall(b"")

    def disconnected(self) -> bool:
        """Whether the client has hung up; noticed while bytes of it lie unread, too."""
        return not self._stopping and any(events & GONE for _, events in self._poll.poll(0))

    def linger(self) -> None:
        """Say that nothing follows, and throw away what still comes, for `LINGER_S`."""
        with suppress(OSError, Disconnected):
            self.flush(LINGER_S)
            self.socket.shutdown(socket.SHUT_WR)
            self.read_until(now_ns() + round(LINGER_S * 1e9))
            while self.recv(1 << 18):
                pass

    def read_no_more(self) -> None:
        """Let whoever reads find the end; an answer under way may still be written."""
        self._stopping = True
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)

    def hang_up(self) -> None:
        """Break the connection."""
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()


def wait_at_most(connection: socket.socket, seconds: float) -> None:
    """Let blocking calls end with BlockingIOError after so long, 0: never; `settimeout` would cost each a poll."""
    whole = int(seconds)
    value = _TIMEVAL.pack(whole, max(int((seconds - whole) * 1e6), int(seconds > 0 and not whole)))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)
