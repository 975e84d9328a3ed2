"""An engine without a model: answers at once, so that a run shows what the transport alone costs.

With ``latency`` it answers after latencies that are known beforehand (`boards.latency.sequence_ns`). Such times are
emulated, never measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle, islice

from s2a_bench.boards.latency import read_latency, sequence_ns
from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import EngineError, UsageError
from s2a_bench.facts import LATENCY_DRAWN_MS, Fact
from s2a_bench.inference import Engine, EngineConfig, chunk
from s2a_bench.types import Piece, Request, Token


def _sequence_ns(config: EngineConfig) -> Iterator[int]:
    latencies = read_latency(config.latency)
    if latencies is None:
        raise UsageError(f"`latency`: '{config.latency}' should be a number of ms, a family, or a .csv file")
    return sequence_ns(latencies)


class EchoEngine(Engine):
    """Says the prompt's words again and again until ``max_tokens``, or a chunk of actions; the rest is ignored.

    With ``latency`` request k, counted from 0 since the engine was opened, is answered with the k-th latency: all
    pieces come at that time after the request, the first no sooner than the last.
    """

    acts = True
    needs_model = False
    computes = False
    exclusive_options = ("latency",)
    declared_facts = (LATENCY_DRAWN_MS,)

    @classmethod
    def check(cls, config: EngineConfig) -> None:
        """Raise UsageError where ``latency`` is none, or goes with a pace."""
        if not config.latency:
            return
        if config.pace:
            raise UsageError("`pace`: with `latency` the whole answer comes at once; leave out one of them")
        _sequence_ns(config)

    @classmethod
    def facts_for(cls, config: EngineConfig) -> Sequence[Fact]:
        return cls.declared_facts if config.latency else ()

    def __init__(self, config: EngineConfig, clock: Clock | None = None) -> None:
        """Read the latencies, if any; raises UsageError for what `check` refuses."""
        self.check(config)
        self._facts: dict[str, float] = {}
        self._config = config
        self._clock = clock or SystemClock()
        self._latencies_ns = _sequence_ns(config) if config.latency else None
        self._closed = False

    @property
    def facts(self) -> dict[str, float]:
        return self._facts

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the prompt's words as tokens, where there are none "echo"; or the actions of a chunk."""
        if self._closed:
            raise EngineError("echo: the engine is closed; open a new one")
        if self._latencies_ns is not None:
            asked_ns, latency_ns = self._clock.now_ns(), next(self._latencies_ns)
            self._facts = {LATENCY_DRAWN_MS: latency_ns / 1e6}
            self._clock.sleep_until_ns(asked_ns + latency_ns)
        if self._config.chunks:
            yield from chunk(self._config, request)
            return
        words = request.prompt.split() or ["echo"]
        for index, word in enumerate(islice(cycle(words), max(0, request.max_tokens))):
            yield Token(index, word if index == 0 else f" {word}")

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say that nothing but an echo answers, and after which latencies."""
        told: dict[str, str | int | float | bool] = {"engine": self._config.name, "model": "none", "dummy": True}
        told |= {"emulated": True, "latency": self._config.latency} if self._config.latency else {}
        return told | ({"answer": self._config.pieces} if self._config.chunks else {})

    def close(self) -> None:
        self._closed = True
