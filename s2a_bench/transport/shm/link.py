"""A client's link: the socket, the memory that it writes and, when the server has answered, the memory that it reads."""

from __future__ import annotations

from typing import Final

from s2a_bench.transport.shm.door import connect, wait_at_most
from s2a_bench.transport.shm.memory import ANSWER_BYTES, PLACE, accept, offer
from s2a_bench.transport.shm.ring import Reader

NEARER_S: Final = 0.1
"""A wait that ends later than it should by no more than this is left as it is: to change it is a system call."""


class Link:
    """A connection with memory for requests of ``size`` bytes."""

    def __init__(self, path: str, size: int, patience_s: float) -> None:
        """Connect and offer memory; raises OSError, TransportError."""
        self._socket = connect(path, patience_s)
        self._waits_s = patience_s
        self._reader: Reader | None = None
        try:
            self.requests = offer(self._socket, size)
        except BaseException:
            self._socket.close()
            raise

    def ask(self, at: int, length: int) -> None:
        """Tell of a request whose header lies there; raises OSError."""
        if self._reader is not None:
            self._reader.begin()
        self._socket.send(PLACE.pack(at, length))

    def next(self, wait_s: float) -> bytes:
        """Return the next piece; raises BlockingIOError after ``wait_s``, EOFError, OSError, ValueError, TransportError."""
        if not self._waits_s - NEARER_S <= wait_s <= self._waits_s + NEARER_S:
            wait_at_most(self._socket, wait_s)
            self._waits_s = wait_s
        if self._reader is None:
            self._reader = Reader(accept(self._socket, ANSWER_BYTES), self.requests)
        packet = self._socket.recv(PLACE.size + 1)
        if not packet:
            raise EOFError
        return self._reader.read(packet)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()
