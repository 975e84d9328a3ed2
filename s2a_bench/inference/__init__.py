"""What answers: an Engine turns a request with RGB pictures into a stream of tokens, or of actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol

from pydantic import BeforeValidator

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import Fact
from s2a_bench.inference.llama_settings import FLASH_ATTENTION, KV_TYPES, LARGEST, LEAST_BATCH, LEAST_CONTEXT, SAMPLINGS
from s2a_bench.options import Options, one_of, option
from s2a_bench.registry import Registry
from s2a_bench.types import Piece, Request


class Engine(Protocol):
    """A model, or something that behaves like one. One request at a time; not thread-safe."""

    @property
    def facts(self) -> dict[str, float]:
        """Return what it tells of the last request, as llama.cpp's ``timings``: those that its class declares."""
        ...

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the answer's pieces, at most ``request.max_tokens``; closing the iterator cancels the rest.

        Pictures are ``rgb8``. Raises EngineError for a request that cannot be answered (a bad grammar,
        a prompt longer than the context).
        """
        ...

    def describe(self) -> dict[str, str | int | float | bool]:
        """Return what answers, for the manifest: engine, model file, hash, whether the weights are dummies."""
        ...

    def close(self) -> None:
        """Free the model; may be called twice."""
        ...


ENGINES: Final[Registry[Callable[[EngineConfig], Engine]]] = Registry(
    "engines",
    "engine",
    {
        "llama": "s2a_bench.inference.one_thread:Llama",
        "echo": "s2a_bench.inference.echo:EchoEngine",
        "replay": "s2a_bench.inference.replay:ReplayEngine",
    },
)
"""What builds each engine from its configuration: its class, which names its facts as ``tells``."""

CHECKS: dict[str, str] = {"llama-build": "s2a_bench.inference.checks:llama_build"}
"""Code -> ``module:function`` of the doctor's checks that are about engines."""


ANSWERS: Final = ("answer", "horizon", "action_dim")
"""The options that say what an answer is made of."""

ACTING: Final = "echo or replay"
"""The engines that answer with actions, for errors."""


def _written(value: Any) -> Any:
    return str(value) if isinstance(value, (int, float)) else value


class EngineConfig(Options):
    """Which engine, on which files, with which settings; plain data, so that a server process can be told."""

    name: Annotated[str, one_of(lambda: ENGINES)] = option(
        "llama",
        f"{', '.join(ENGINES)}; echo leaves the transport alone, replay plays --profile (EMULATED)",
        flag="engine",
    )
    profile: str = option("", "what --engine replay plays: a name of 'profile list', or a path")
    gaps: str = option("", "replay: trace, parametric, constant [default: trace if recorded]")
    latency: Annotated[str, BeforeValidator(_written)] = option(
        "",
        "echo: how long until an answer is there, whole: ms, FAMILY:mean_ms=...,key=value, FILE.csv [default: at once]",
    )
    model: Path | None = option(None, "GGUF model [default: the tiny dummy]")
    mmproj: Path | None = option(None, "GGUF vision tower that goes with --model")
    threads: int = option(0, "CPU threads of the model; 0: all", ge=0, le=LARGEST)
    gpu_layers: int = option(0, "model layers on the GPU; -1: all", ge=-1, le=LARGEST)
    context: int = option(4096, "context length in tokens", ge=LEAST_CONTEXT, le=LARGEST)
    batch: int = option(512, "the most prompt tokens evaluated at once", ge=LEAST_BATCH, le=LARGEST)
    kv_type: Annotated[str, one_of(lambda: KV_TYPES)] = option("f16", "KV cache: f32, f16, q8_0, q4_0")
    flash_attention: Annotated[str, one_of(lambda: FLASH_ATTENTION)] = option(
        "auto", "auto (what is faster here, measured once), on, off"
    )
    sampling: Annotated[str, one_of(lambda: SAMPLINGS)] = option(
        "model", "model (as its authors recommend), greedy (the likeliest token)"
    )
    answer: Literal["auto", "tokens", "actions"] = option(
        "auto", "tokens, actions (chunks, as policies answer), auto (actions where a transport carries nothing else)"
    )
    horizon: int = option(16, "actions of a chunk", ge=1, le=4096)
    action_dim: int = option(7, "numbers of an action", ge=1, le=1024)
    pace: float | None = option(
        None, "hold the answer back to so many tokens/s [default: the model's own]", gt=0, le=10_000
    )

    def check(self) -> None:
        """Refuse a cache that no kernel reads."""
        if self.kv_type in {"q8_0", "q4_0"} and self.flash_attention == "off":
            raise UsageError(
                f"`kv_type` {self.kv_type} needs flash attention, which alone reads a quantised V cache; "
                "leave out `flash_attention` off"
            )
        if self.chunks and "name" in self.model_fields_set and not acts(self.name):
            raise UsageError(f"`answer`: `engine` {self.name} answers with tokens alone; use `engine` {ACTING}")

    @property
    def chunks(self) -> bool:
        """Whether it answers with actions."""
        return self.answer == "actions"

    @property
    def told(self) -> Sequence[Fact]:
        """Return the facts that the engine tells, set like this."""
        told: Callable[[EngineConfig], Sequence[Fact]] | None = getattr(ENGINES[self.name], "told", None)
        return told(self) if told else told_by(self.name)

    @property
    def pieces(self) -> str:
        """Return what an answer of actions is, in words."""
        return f"{self.horizon} actions of {self.action_dim}"


def acts(name: str) -> bool:
    """Whether an engine can answer with actions."""
    return bool(getattr(ENGINES[name], "acts", False))


def told_by(name: str) -> Sequence[Fact]:
    """Return the facts that an engine may tell."""
    return getattr(ENGINES[name], "tells", ())


def honoured_by(name: str) -> Sequence[str]:
    """Return the names in `Request.sampling` that an engine honours."""
    return getattr(ENGINES[name], "honours", ())


def default_engine(say: Callable[[str], None]) -> str:
    """Return llama where it is installed, else echo, and ``say`` so."""
    if extras.installed("llama_cpp"):
        return "llama"
    say(f"no llama-cpp-python here, so the echo engine answers, without a model; {extras.how_to_install('llama')}")
    return "echo"


def check_engine(config: EngineConfig) -> None:
    """Raise UsageError where an engine's own options, and the engine, do not go together."""
    from s2a_bench.inference.echo import check_latency
    from s2a_bench.inference.replay import check_replay

    check_replay(config)
    check_latency(config)


def need_engine(name: str) -> None:
    """Raise MissingExtra where what an engine needs is not installed."""
    if name == "llama":
        extras.need("llama", "llama_cpp", "gguf")


def open_engine(config: EngineConfig) -> Engine:
    """Start the engine that ``config`` names; raises UsageError for an unknown name, EngineError otherwise."""
    engine = ENGINES[config.name](config)
    if config.pace:
        from s2a_bench.inference.paced import PacedEngine

        return PacedEngine(engine, config.pace)
    return engine
