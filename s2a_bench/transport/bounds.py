"""What a client takes of one answer, over every transport: so much time, so many pieces, so many bytes."""

from __future__ import annotations

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed

PIECES_A_TOKEN, PIECES = 8, 64
"""A server may count otherwise, or send letters: an answer may have so many pieces a token, and some more."""
BYTES_A_TOKEN, BYTES = 16 << 10, 5 << 20
"""All that comes, headers included, in the same way; a token in OpenAI's dialect takes 300 bytes."""


class Bounds:
    """The bounds of one answer, told of what comes."""

    def __init__(self, who: str, deadline_s: float, max_tokens: int) -> None:
        """Start the time; errors name ``who`` answers."""
        self._who = who
        self._deadline_s = deadline_s
        self._ends_ns = now_ns() + int(deadline_s * 1e9)
        self._max_tokens = max_tokens
        self._most_pieces = self._pieces = PIECES + PIECES_A_TOKEN * max_tokens
        self._most_bytes = self._bytes = BYTES + BYTES_A_TOKEN * max_tokens

    def left_s(self) -> float:
        """Return the time that is left; raises RequestFailed after the deadline."""
        left_ns = self._ends_ns - now_ns()
        if left_ns <= 0:
            raise RequestFailed(
                f"{self._who} did not end its answer within {self._deadline_s:g} s; see `deadline` and `max_tokens`"
            )
        return left_ns / 1e9

    def came(self, size: int) -> None:
        """Count bytes; raises RequestFailed for more than an answer can need."""
        self._bytes -= size
        if self._bytes < 0:
            raise RequestFailed(
                f"{self._who} sent more than {self._most_bytes} bytes for {self._max_tokens} tokens (`max_tokens`)"
            )

    def piece(self) -> None:
        """Count a piece of the answer; raises RequestFailed where the server does not stop."""
        self._pieces -= 1
        if self._pieces < 0:
            raise RequestFailed(
                f"{self._who} does not stop: {self._most_pieces} pieces came for {self._max_tokens} tokens "
                "(`max_tokens`)"
            )
