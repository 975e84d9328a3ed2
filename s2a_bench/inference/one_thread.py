"""An engine kept on one thread, whichever threads ask it.

llama.cpp computes with OpenMP, and libgomp keeps a team of threads for every thread that ever asked. Where a server's
threads take turns, teams add up, libgomp sees more threads than cores and stops spinning between operations: half the
speed for a small model. So all of an engine's work is done on one thread; changing to it is part of `inference`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from s2a_bench.errors import EngineError
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.types import Request, Token


class OneThreadEngine:
    """Does everything an engine does on a thread of its own; behaves like the engine otherwise."""

    def __init__(self, make: Callable[[], Engine]) -> None:
        """Make the engine on its thread; raises what ``make`` raises."""
        self._closed = False
        self._thread = ThreadPoolExecutor(1, "engine")
        try:
            self._engine = self._thread.submit(make).result()
        except BaseException:
            self._thread.shutdown()
            raise

    @property
    def facts(self) -> dict[str, float]:
        """Return the engine's own facts about the last request."""
        return self._engine.facts

    def generate(self, request: Request) -> Generator[Token, None, None]:
        """Yield the engine's tokens, each computed when it is asked for."""
        tokens = self._run(self._engine.generate, request)
        try:
            while (token := self._run(next, tokens, None)) is not None:
                yield token
        finally:
            self._run(_close, tokens)

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say what the engine says."""
        described: dict[str, str | int | float | bool] = self._run(self._engine.describe)
        return described

    def close(self) -> None:
        """Free the engine and end its thread."""
        if not self._closed:
            self._run(self._engine.close)
            self._closed = True
            self._thread.shutdown()

    def _run(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Do one thing on the engine's thread."""
        if self._closed:
            raise EngineError("the engine is closed; open a new one")
        return self._thread.submit(work, *arguments).result()


def _close(tokens: object) -> None:
    """Cancel what an engine's iterator has not yielded."""
    close = getattr(tokens, "close", None)
    if close is not None:
        close()


def llama(config: EngineConfig) -> OneThreadEngine:
    """Start the llama engine on a thread of its own."""
    from s2a_bench.inference.llama_cpp import LlamaCppEngine

    return OneThreadEngine(lambda: LlamaCppEngine(config))
