"""Events of answers in memory that goes round: written where the reader has been already."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

from s2a_bench.errors import RequestFailed
from s2a_bench.transport.shm.memory import ANSWER_BYTES, EVENT, PACKET, READ, Memory

POLL_S = 0.001
"""How often a writer looks whether a slow reader has gone on."""


def place(before: int, length: int) -> int:
    """Return where an event begins that comes after so many bytes: it does not lie across the end."""
    at = before % ANSWER_BYTES
    return before if at + length <= ANSWER_BYTES else before - at + ANSWER_BYTES


class Writer:
    """The server's side."""

    def __init__(self, memory: Memory) -> None:
        """Begin at the beginning."""
        self._memory, self._written = memory, 0

    def send(self, link: socket.socket, event: bytes, requests: Memory, left_s: Callable[[], float]) -> None:
        """Write an event and tell of it; waits for a slow reader until there is no time ``left_s``."""
        if len(event) > ANSWER_BYTES // 2:
            raise RequestFailed(f"an event of {len(event)} bytes is larger than this wire carries")
        begin = place(self._written, len(event))
        while begin + len(event) - self._read(requests) > ANSWER_BYTES:
            if left_s() <= 0:
                raise RequestFailed("the client does not read its answer")
            time.sleep(POLL_S)
        at = begin % ANSWER_BYTES
        self._memory.bytes[at : at + len(event)] = memoryview(event)
        self._written = begin + len(event)
        link.send(PACKET.pack(EVENT, begin, len(event)))

    def _read(self, requests: Memory) -> int:
        """Return how far the reader says that it is, within what can be."""
        (said,) = READ.unpack_from(requests.bytes.data)
        return int(min(max(said, self._written - ANSWER_BYTES), self._written))


def read(memory: Memory, begin: int, length: int) -> bytes:
    """Copy an event out of what the server wrote; raises ValueError for a place that is none."""
    at = begin % ANSWER_BYTES
    if not (length > 0 and at + length <= min(memory.size, ANSWER_BYTES)):
        raise ValueError(f"an event of {length} bytes at {begin} is none")
    return memory.bytes[at : at + length].tobytes()
