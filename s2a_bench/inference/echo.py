"""An engine without a model that answers at once, so that a run measures the transport alone.

With ``latency`` it answers after latencies that are known beforehand (`boards.latency.sequence_ns`). Such times are
emulated, never measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle, islice

from s2a_bench.boards.latency import read_latency, sequence_ns
from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import UsageError
from s2a_bench.facts import LATENCY_DRAWN_MS, Fact
from s2a_bench.inference import Engine, EngineConfig, chunk
from s2a_bench.types import Piece, Request, Token


def _sequence_ns(config: EngineConfig) -> Iterator[int]:
    latencies = read_latency(config.latency)
    if latencies is None:
        raise UsageError(f"`latency`: '{config.latency}' should be a number of ms, a family, or a .csv file")
    return sequence_ns(latencies)


class EchoEngine(Engine):
    """Repeats the prompt, word by word, up to ``max_tokens``, or sends a chunk of actions; ignores the rest.

    With ``latency`` request k, counted from 0 since the engine was opened, is answered with the k-th latency: all
    pieces arrive at that time after the request, the first no sooner than the last.
    """

    acts = True
    needs_model = False
    computes = False
    exclusive_options = ("latency",)
    declared_facts = (LATENCY_DRAWN_MS,)

    @classmethod
    def check(cls, config: EngineConfig) -> None:
        if not config.latency:
            return
        if config.pace:
            raise UsageError("`pace`: with `latency` the whole answer arrives at once; leave out one of them")
        _sequence_ns(config)

    @classmethod
    def facts_for(cls, config: EngineConfig) -> Sequence[Fact]:
        return cls.declared_facts if config.latency else ()

    def __init__(self, config: EngineConfig, clock: Clock | None = None) -> None:
        self.check(config)
        self._config = config
        self._clock = clock or SystemClock()
        self._latencies_ns = _sequence_ns(config) if config.latency else None

    def generate(self, request: Request) -> Iterator[Piece]:
        self.need_open()
        if self._latencies_ns is not None:
            started_ns, latency_ns = self._clock.now_ns(), next(self._latencies_ns)
            self._facts = {LATENCY_DRAWN_MS: latency_ns / 1e6}
            self._clock.sleep_until_ns(started_ns + latency_ns)
        if self._config.chunks:
            yield from chunk(self._config, request)
            return
        texts = cycle(request.prompt.split() or ["echo"])
        for index, text in enumerate(islice(texts, max(0, request.max_tokens))):
            yield Token(index, f" {text}" if index else text)

    def describe(self) -> dict[str, str | int | float | bool]:
        facts: dict[str, str | int | float | bool] = {"engine": self._config.name, "model": "none", "dummy": True}
        facts |= {"emulated": True, "latency": self._config.latency} if self._config.latency else {}
        return facts | ({"answer": self._config.pieces} if self._config.chunks else {})
