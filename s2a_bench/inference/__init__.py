"""What answers: an Engine turns a request with RGB pictures into a stream of tokens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from s2a_bench.registry import Registry
from s2a_bench.types import Request, Token


class Engine(Protocol):
    """A model, or something that behaves like one. One request at a time; not thread-safe."""

    @property
    def facts(self) -> dict[str, float]:
        """Return what it says about the last request, as llama.cpp's ``timings``: prompt_n, prompt_ms, ..."""
        ...

    def generate(self, request: Request) -> Iterator[Token]:
        """Yield the answer's tokens, at most ``request.max_tokens``; closing the iterator cancels the rest.

        Pictures are ``rgb8``. Raises EngineError for a request that cannot be answered (a bad grammar,
        a prompt longer than the context).
        """
        ...

    def describe(self) -> dict[str, str | int | float | bool]:
        """Say what answers, for the manifest: engine, model file, hash, whether the weights are dummies."""
        ...

    def close(self) -> None:
        """Free the model; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class EngineConfig:
    """Which engine, on which files, with which settings; plain data, so that a server process can be told."""

    name: str = "llama"
    model: Path | None = None
    """GGUF language model; None: the tiny dummy, made on first use."""
    mmproj: Path | None = None
    """GGUF vision tower and projector that goes with ``model``."""
    threads: int = 0
    """CPU threads; 0: as many as this process may use."""
    gpu_layers: int = 0
    """Layers on the GPU; -1: all."""
    context: int = 4096
    """Context length in tokens."""
    batch: int = 512
    """The most prompt tokens evaluated at once (llama.cpp's ``n_batch`` and ``n_ubatch``)."""
    kv_type: str = "f16"
    """Type of the KV cache: f32, f16, q8_0, q4_0."""
    flash_attention: str = "auto"
    """auto, on, off."""
    sampling: str = "model"
    """model: as its authors recommend; greedy: the likeliest token."""
    profile: str = ""
    """replay: name or path of the hardware profile."""
    gaps: str = ""
    """replay: trace (the recorded gaps), parametric, constant; empty: the best that the profile has."""
    pace: float = 0.0
    """Tokens/s that answers are held back to; 0: as fast as they come."""


ENGINES: Final[Registry[Callable[[EngineConfig], Engine]]] = Registry(
    "engines",
    "engine",
    {
        "llama": "s2a_bench.inference.one_thread:llama",
        "echo": "s2a_bench.inference.echo:EchoEngine",
        "replay": "s2a_bench.inference.replay:ReplayEngine",
    },
)
"""What builds each engine from its configuration."""

CHECKS: dict[str, str] = {"llama-build": "s2a_bench.inference.checks:llama_build"}
"""Code -> ``module:function`` of the doctor's checks that are about engines."""


def open_engine(config: EngineConfig) -> Engine:
    """Start the engine that ``config`` names; raises UsageError for an unknown name, EngineError otherwise."""
    engine = ENGINES[config.name](config)
    if config.pace:
        from s2a_bench.inference.paced import PacedEngine

        return PacedEngine(engine, config.pace)
    return engine
