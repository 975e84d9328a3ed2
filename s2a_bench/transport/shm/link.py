"""A client's link: the socket, the memory that it writes, and the memory that it reads once the server has answered."""

from __future__ import annotations

from contextlib import suppress
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
        except BaseException as error:
            with self._socket:
                self._reason(error)
            raise

    def ask(self, at: int, length: int) -> None:
        """Tell of a request whose header lies there; raises OSError, TransportError."""
        if self._reader is not None:
            self._reader.begin()
        try:
            self._socket.send(PLACE.pack(at, length))
        except OSError as error:
            self._reason(error)
            raise

    def next(self, wait_s: float) -> bytes:
        """Return the next piece; raises BlockingIOError after ``wait_s``, and what `accept` and `Reader` raise."""
        if not self._waits_s - NEARER_S <= wait_s <= self._waits_s + NEARER_S:
            wait_at_most(self._socket, wait_s)
            self._waits_s = wait_s
        if self._reader is None:
            self._reader = Reader(accept(self._socket, ANSWER_BYTES), self.requests)
        packet = self._socket.recv(PLACE.size + 1)
        if not packet:
            raise EOFError
        return self._reader.read(packet)

    def _reason(self, error: BaseException) -> None:
        """Raise what a server said that has closed a new link."""
        if isinstance(error, BrokenPipeError | ConnectionResetError) and self._reader is None:
            with suppress(OSError, EOFError):
                accept(self._socket, ANSWER_BYTES)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()
