"""Run an engine on one thread, whichever threads call it.

llama.cpp computes with OpenMP, and libgomp keeps a team of threads for every calling thread. If a server's threads take
turns, teams add up, libgomp finds more threads than cores and stops spinning between operations: half the speed for a
small model. So all of an engine's work is done on one thread, which engines that take turns in one process share;
changing to it is part of `inference`.

Changing threads costs some 50 us, a sixth of a small model's token. So the engine does not wait for the reader: it
computes the next token while the last one is sent, as llama-server does, and is at most `AHEAD` tokens ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from queue import SimpleQueue
from typing import Any

from s2a_bench.errors import EngineError
from s2a_bench.facts import LLAMA
from s2a_bench.inference import PENALTY_LAST_N, SAMPLER_ARGUMENTS, Engine, EngineConfig, cancel
from s2a_bench.types import Piece, Request

AHEAD = 8
"""Tokens that may wait for the reader before the engine waits too."""


class _Answer:
    def __init__(self) -> None:
        self.wanted = True
        self._tokens: SimpleQueue[Piece | None] = SimpleQueue()
        self._places: SimpleQueue[None] = SimpleQueue()  # a semaphore, but one in C
        for _ in range(AHEAD):
            self._places.put(None)

    def write(self, tokens: Iterator[Piece]) -> None:
        try:
            while self._wait_for_place() and (token := next(tokens, None)) is not None:
                self._tokens.put(token)
        finally:
            cancel(tokens)
            self._tokens.put(None)

    def _wait_for_place(self) -> bool:
        self._places.get()
        return self.wanted

    def read(self) -> Iterator[Piece]:
        while (token := self._tokens.get()) is not None:
            self._places.put(None)
            yield token

    def cancel(self) -> None:
        self.wanted = False
        self._places.put(None)  # wakes a writer that waits for a place


class OneThreadEngine(Engine):
    """Calls an engine on a separate thread, or on another engine's ``thread``."""

    def __init__(self, make: Callable[[], Engine], thread: ThreadPoolExecutor | None = None) -> None:
        self._answer = _Answer()
        self._thread = thread or ThreadPoolExecutor(1, "engine")
        self._shares = thread is not None
        try:
            self._engine = self._thread.submit(make).result()
        except BaseException:
            self._end_thread()
            raise

    @property
    def facts(self) -> dict[str, float]:
        return self._engine.facts

    def generate(self, request: Request) -> Generator[Piece, None, None]:
        """Yield the engine's tokens, which it computes ahead; a later request ends this one, as does closing it."""
        self._answer.cancel()
        answer = self._answer = _Answer()
        writing = self._submit(lambda: answer.write(self._engine.generate(request)))
        try:
            yield from answer.read()
            if answer is not self._answer:
                raise EngineError("a later request took over the engine; one request at a time")
            if not answer.wanted:
                raise EngineError("the engine was closed before its answer was complete")
            writing.result()
        finally:
            answer.cancel()
            wait([writing])

    def describe(self) -> dict[str, str | int | float | bool]:
        described: dict[str, str | int | float | bool] = self._submit(self._engine.describe).result()
        return described

    def close(self) -> None:
        if not self._closed:
            self._answer.cancel()  # else the thread may wait for the reader, and `close` for the thread
            self._submit(self._engine.close).result()
            self._closed = True
            self._end_thread()

    def _end_thread(self) -> None:
        if not self._shares:
            self._thread.shutdown()

    def _submit(self, work: Callable[[], Any]) -> Future[Any]:
        if self._closed:
            raise EngineError("the engine is closed; open a new one")
        return self._thread.submit(work)


class Llama(OneThreadEngine):
    needs = ("llama", "llama_cpp", "gguf")
    declared_facts = LLAMA
    honours = (*SAMPLER_ARGUMENTS, PENALTY_LAST_N)

    def __init__(self, config: EngineConfig, thread: ThreadPoolExecutor | None = None) -> None:
        def make() -> Engine:
            from s2a_bench.inference.llama_cpp import LlamaCppEngine

            return LlamaCppEngine(config)

        super().__init__(make, thread)

    def open_beside(self, config: EngineConfig) -> Llama:
        return Llama(config, self._thread)
