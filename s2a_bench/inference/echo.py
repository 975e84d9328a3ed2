"""An engine without a model: answers at once, so that a run shows what the transport alone costs."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, islice

from s2a_bench.errors import EngineError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.chunk import chunk
from s2a_bench.types import Piece, Request, Token


class EchoEngine:
    """Says the prompt's words again and again until ``max_tokens``, or a chunk of actions; the rest is ignored."""

    acts = True

    def __init__(self, config: EngineConfig) -> None:
        """Take the settings for their name only."""
        self.facts: dict[str, float] = {}
        self._config = config
        self._closed = False

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the prompt's words as tokens, where there are none "echo"; or the actions of a chunk."""
        if self._closed:
            raise EngineError("echo: the engine is closed; open a new one")
        if self._config.chunks:
            yield from chunk(self._config, request)
            return
        words = request.prompt.split() or ["echo"]
        for index, word in enumerate(islice(cycle(words), max(0, request.max_tokens))):
            yield Token(index, word if index == 0 else f" {word}")

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say that nothing but an echo answers."""
        chunks = {"answer": self._config.pieces} if self._config.chunks else {}
        return {"engine": self._config.name, "model": "none", "dummy": True, **chunks}

    def close(self) -> None:
        """Refuse further requests."""
        self._closed = True
