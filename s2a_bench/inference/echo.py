"""An engine without a model: answers at once, so that a run shows what the transport alone costs."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, islice

from s2a_bench.errors import EngineError
from s2a_bench.inference import EngineConfig
from s2a_bench.types import Request, Token


class EchoEngine:
    """Says the prompt's words again and again until ``max_tokens``; pictures and grammar are ignored."""

    def __init__(self, config: EngineConfig) -> None:
        """Take the settings for their name only."""
        self.facts: dict[str, float] = {}
        self._config = config
        self._closed = False

    def generate(self, request: Request) -> Iterator[Token]:
        """Yield the prompt's words as tokens; an empty prompt is answered with "echo"."""
        if self._closed:
            raise EngineError("echo: the engine is closed; open a new one")
        words = request.prompt.split() or ["echo"]
        for index, word in enumerate(islice(cycle(words), max(0, request.max_tokens))):
            yield Token(index, word if index == 0 else f" {word}")

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say that nothing but an echo answers."""
        return {"engine": self._config.name, "model": "none", "dummy": True}

    def close(self) -> None:
        """Refuse further requests."""
        self._closed = True
