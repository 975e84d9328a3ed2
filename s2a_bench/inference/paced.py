"""Another engine's answers, held back to a rate: real tokens, whose rate is set and not the model's."""

from __future__ import annotations

from collections.abc import Generator, Iterator

from s2a_bench.clock import Clock, SystemClock
from s2a_bench.inference import Engine
from s2a_bench.types import Piece, Request


class PacedEngine:
    """Lets the first token go when it is there, and each further one no sooner than its place in the rate.

    Deadlines count from the first token, so that late wake-ups do not add up; tokens later than that go at once.
    """

    def __init__(self, engine: Engine, tokens_per_s: float, clock: Clock | None = None) -> None:
        """Take over ``engine``; ``tokens_per_s`` is above 0."""
        self._engine = engine
        self._rate = tokens_per_s
        self._clock = clock or SystemClock()

    @property
    def facts(self) -> dict[str, float]:
        """Return the engine's own facts about the last request."""
        return self._engine.facts

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the engine's tokens, each at its time or later."""
        first_ns = 0
        tokens = self._engine.generate(request)
        try:
            for index, token in enumerate(tokens):
                if not index:
                    first_ns = self._clock.now_ns()
                self._clock.sleep_until_ns(first_ns + round(index / self._rate * 1e9))
                yield token
        finally:
            if isinstance(tokens, Generator):
                tokens.close()  # the rest is not wanted

    def describe(self) -> dict[str, str | int | float | bool]:
        """Return what the engine says, and the rate."""
        return {**self._engine.describe(), "paced_tokens_per_s": self._rate}

    def close(self) -> None:
        """Close the engine."""
        self._engine.close()
