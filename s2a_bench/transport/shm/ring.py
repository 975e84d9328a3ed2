"""An answer in memory that goes round: written from its beginning at every request, where the reader has been already.

A server's packet says how many bytes were written before a piece, counting those that were skipped so that no piece
lies across the end, and the piece's length. The client counts what it has read at the beginning of its own memory.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from s2a_bench.errors import RequestFailed
from s2a_bench.transport.shm.memory import ANSWER_BYTES, PLACE, Memory

PIECE_BYTES: Final = ANSWER_BYTES // 2
"""The largest piece: it has room wherever the one before it ended."""
POLL_S: Final = 0.001
"""How often it is looked whether a slow reader has gone on."""


class Writer:
    """The server's side: what a slow client has no room for waits in here, so that the engine never does."""

    def __init__(self, link: socket.socket, answers: Memory, requests: Memory) -> None:
        """Write into ``answers`` and tell of it over the link; ``requests`` is the client's."""
        self._link, self._answers = link, answers
        self._said = memoryview(requests.map)[:8].cast("Q")
        self._written = 0
        self._late: deque[bytes] = deque()

    def begin(self) -> None:
        """Begin an answer."""
        self._written = 0
        self._late.clear()

    def send(self, piece: bytes) -> None:
        """Write a piece and tell of it, now or later; raises OSError where the client has gone."""
        if len(piece) > PIECE_BYTES:
            raise RequestFailed(f"a piece of {len(piece)} bytes is larger than this wire carries")
        if self._late:
            self.catch_up()
            if self._late and not is_there(self._link):
                raise ConnectionAbortedError("the client has gone")
        if self._late or not self._put(piece):
            self._late.append(piece)

    def finish(self, left_s: Callable[[], float]) -> None:
        """Wait for a slow client to take the rest, until no time is left; raises OSError where it has gone."""
        while self._late:
            self.catch_up()
            if self._late:
                if left_s() <= 0 or not is_there(self._link):
                    raise ConnectionAbortedError("the client does not read its answer")
                time.sleep(POLL_S)

    def catch_up(self) -> None:
        """Write what is late, as far as there is room."""
        while self._late and self._put(self._late[0]):
            self._late.popleft()

    def _put(self, piece: bytes) -> bool:
        """Write a piece if there is room."""
        at = self._written % ANSWER_BYTES
        begin = self._written if at + len(piece) <= ANSWER_BYTES else self._written - at + ANSWER_BYTES
        end = begin + len(piece)
        if end > ANSWER_BYTES and end - min(self._said[0], self._written) > ANSWER_BYTES:
            return False
        at = begin % ANSWER_BYTES
        self._answers.map[at : at + len(piece)] = piece
        try:
            self._link.send(PLACE.pack(begin, len(piece)), socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        self._written = end
        return True


class Reader:
    """The client's side."""

    def __init__(self, answers: Memory, requests: Memory) -> None:
        """Read ``answers``; how far, ``requests`` tells the server."""
        self._answers = answers
        self._said = memoryview(requests.map)[:8].cast("Q")  # one store of eight bytes, never seen in halves

    def begin(self) -> None:
        """Begin an answer."""
        self._said[0] = 0

    def read(self, packet: bytes) -> bytes:
        """Copy the piece that a packet tells of, and let it go; raises ValueError for a place that is none."""
        if len(packet) != PLACE.size:
            raise ValueError(f"a packet of {len(packet)} bytes is none of an answer")
        begin, length = PLACE.unpack(packet)
        at = begin % ANSWER_BYTES
        if not (length > 0 and at + length <= self._answers.size and begin + length < 1 << 63):
            raise ValueError(f"a piece of {length} bytes at {begin} cannot be")
        piece = self._answers.map[at : at + length]
        self._said[0] = begin + length
        return piece


def is_there(link: socket.socket) -> bool:
    """Whether a client that has nothing to say has not closed its end."""
    try:
        return bool(link.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
    except BlockingIOError:
        return True
    except OSError:
        return False
