"""The engine `toy-words`: counts aloud, or waves; it needs no model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from s2a_bench.errors import EngineError
from s2a_bench.facts import Fact
from s2a_bench.inference import Engine, EngineConfig, chunk
from s2a_bench.types import Piece, Request, Token

TOY_COUNTED = Fact("toy_counted", "words", "how far it has counted")


class ToyWords(Engine):
    """Says "1 2 3 ..." from the request's seed on, or answers with a chunk of actions."""

    acts = True
    needs_model = False
    computes = False
    declared_facts: ClassVar[tuple[Fact, ...]] = (TOY_COUNTED,)

    def __init__(self, config: EngineConfig) -> None:
        """Keep what is asked for."""
        self._config = config
        self._facts: dict[str, float] = {}
        self._closed = False

    @property
    def facts(self) -> dict[str, float]:
        """Return how far it has counted."""
        return self._facts

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield as many numbers as are wanted, or the actions of a chunk."""
        if self._closed:
            raise EngineError("toy-words: the engine is closed; open a new one")
        if self._config.chunks:
            yield from chunk(self._config, request)
            return
        for index in range(max(0, request.max_tokens)):
            self._facts = {TOY_COUNTED: float(index + 1)}
            yield Token(index, f" {request.seed + index}")

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say that no model answers."""
        return {"engine": "toy-words", "model": "none", "dummy": True}

    def close(self) -> None:
        """Be closed."""
        self._closed = True
