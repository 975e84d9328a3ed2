"""What answers: an Engine turns a request with RGB pictures into a stream of tokens, or of actions; and its options."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, lru_cache
from math import tau
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Protocol, TypeAlias

from pydantic import BeforeValidator

from s2a_bench import extras
from s2a_bench.boards.profile import profile_files
from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import MissingExtra, UsageError
from s2a_bench.facts import Fact
from s2a_bench.options import Options, one_of, option
from s2a_bench.registry import Registry
from s2a_bench.types import Action, Piece, Request

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Engine(Protocol):
    """A model, or something that behaves like one. One request at a time; not thread-safe.

    A subclass declares what is known of it before it is opened.
    """

    acts: ClassVar[bool] = False
    """Whether it can answer with actions."""
    needs_model: ClassVar[bool] = True
    """Whether it loads a model's files, the tiny dummy's unless told: `OF_MODEL` are options of such engines."""
    computes: ClassVar[bool] = True
    """Whether its answers take the time of a model's: a rate, and a plan in them, say something."""
    plays: ClassVar[tuple[str, int] | None] = None
    """The skill set of the plans that it writes, and their tokens a skill, where those of a recording are played."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The extra of this package that it needs, and the modules that this brings."""
    exclusive_options: ClassVar[tuple[str, ...]] = ()
    """The options that no other engine honours."""
    declared_facts: ClassVar[Sequence[Fact]] = ()
    """The facts that it may tell."""
    honours: ClassVar[Sequence[str]] = ()
    """The names in `Request.sampling` that it honours."""

    def __init__(self, config: EngineConfig) -> None:
        """Open it; raises EngineError, and UsageError for what `check` refuses."""

    @classmethod
    def check(cls, config: EngineConfig) -> None:  # noqa: ARG003 - for subclasses
        """Raise UsageError where its own options do not go together."""
        return

    @classmethod
    def facts_for(cls, config: EngineConfig) -> Sequence[Fact]:  # noqa: ARG003 - for subclasses
        """Return the facts that it tells, set like this."""
        return cls.declared_facts

    def open_beside(self, config: EngineConfig) -> Engine:
        """Open one like it in this process, which takes turns with it and is closed before it."""
        return config.kind(config)

    @property
    def facts(self) -> dict[str, float]:
        """Return what it tells of the last request, as llama.cpp's ``timings``: those that its class declares."""
        return {}

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the answer's pieces, at most ``request.max_tokens``; closing the iterator cancels the rest.

        Pictures are ``rgb8``. Raises EngineError for a request that cannot be answered (a bad grammar,
        a prompt longer than the context).
        """
        raise NotImplementedError

    def describe(self) -> dict[str, str | int | float | bool]:
        """Return what answers, for the manifest: engine, model file, hash, whether the weights are dummies."""
        raise NotImplementedError

    def close(self) -> None:
        """Free the model; may be called twice."""
        raise NotImplementedError


ENGINES: Final[Registry[type[Engine]]] = Registry(
    "engines",
    "engine",
    {
        "llama": "s2a_bench.inference.one_thread:Llama",
        "echo": "s2a_bench.inference.echo:EchoEngine",
        "replay": "s2a_bench.inference.replay:ReplayEngine",
    },
)
"""Name -> what is declared of an engine, and opens it from its configuration: its class."""

MODEL, STAND_IN = "llama", "echo"
"""The engine that answers unless told, and the one that does where its library is not installed."""

CHECKS: dict[str, str] = {"llama-build": "s2a_bench.inference.smoke:llama_build"}
"""Code -> ``module:function`` of the doctor's checks that are about engines."""


PERIOD = 50
"""Control ticks of one swing: a second at 50 Hz."""

ANSWERS: Final = ("answer", "horizon", "action_dim")
"""The options that say what an answer is made of."""

OF_MODEL: Final = ("model", "mmproj", "gpu_layers")
"""The options that only an engine with a model can honour."""


KV_TYPES = {"f32": 0, "f16": 1, "q8_0": 8, "q4_0": 2}
"""Type of the KV cache -> ggml's number (``ggml_type``)."""

FLASH_ATTENTION = {"auto": -1, "on": 1, "off": 0}
"""``llama_flash_attn_type``; auto: llama.cpp's choice, on where the device has a kernel for it."""

SAMPLINGS: dict[str, dict[str, float]] = {
    "model": {"temp": 0.7, "top_p": 0.8, "top_k": 100, "min_p": 0.0},
    "greedy": {"temp": 0.0},
}
"""``model`` is that of llama.cpp's ``README-minicpmv2.6.md``, without the penalty on repetition, which breaks
structured output; ``greedy`` takes the likeliest token."""

PENALTY_LAST_N, LAST_N = "penalty_last_n", 64
"""Of how many last tokens repetition is punished: its name in `Request.sampling`, and what it is unless told."""

SAMPLER_ARGUMENTS = {
    **{name: name for name in ("temp", "top_k", "top_p", "min_p", "typical_p", "mirostat_eta", "mirostat_tau")},
    "mirostat": "mirostat_mode",
    "penalty_repeat": "repeat_penalty",
    "penalty_freq": "frequency_penalty",
    "penalty_present": "presence_penalty",
}
"""Name in `Request.sampling` -> the library's name."""

LEAST_CONTEXT, LEAST_BATCH, LARGEST = 256, 32, 1 << 20


def _written(value: Any) -> Any:
    return str(value) if isinstance(value, (int, float)) else value


class EngineConfig(Options):
    """Which engine, on which files, with which settings; plain data, so that a server process can be told."""

    PANEL: ClassVar[str] = "Model"

    name: Annotated[str, one_of(lambda: ENGINES)] = option(
        MODEL,
        f"{', '.join(ENGINES)}; echo leaves the transport alone, replay plays --profile (EMULATED)",
        flag="engine",
        first=True,
    )
    profile: str = option("", "what --engine replay plays: a name of 'profile list', or a path", names=profile_files)
    gaps: str = option("", "replay: trace, parametric, constant [default: trace if recorded]")
    latency: Annotated[str, BeforeValidator(_written, json_schema_input_type=str | float)] = option(
        "",
        "echo: how long until an answer is there, whole: ms, FAMILY:mean_ms=...,key=value, FILE.csv [default: at once]",
    )
    model: Path | None = option(None, "GGUF model [default: the tiny dummy]", first=True)
    mmproj: Path | None = option(None, "GGUF vision tower that goes with --model")
    threads: int = option(0, "CPU threads of the model; 0: all", ge=0, le=LARGEST)
    gpu_layers: int = option(0, "model layers on the GPU; -1: all", ge=-1, le=LARGEST)
    context: int = option(4096, "context length in tokens", ge=LEAST_CONTEXT, le=LARGEST)
    batch: int = option(512, "the most prompt tokens evaluated at once", ge=LEAST_BATCH, le=LARGEST)
    kv_type: Annotated[str, one_of(lambda: KV_TYPES)] = option("f16", "KV cache: f32, f16, q8_0, q4_0")
    flash_attention: Annotated[str, one_of(lambda: FLASH_ATTENTION)] = option(
        "auto", "auto (llama.cpp's own choice), on, off"
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
        if "name" not in self.model_fields_set:
            return
        if self.chunks and not self.kind.acts:
            raise UsageError(f"`answer`: `engine` {self.name} answers with tokens alone; use `engine` {acting()}")
        if self.of_model and not self.kind.needs_model:
            raise UsageError(f"`{self.of_model}` is for an engine with a model; leave it out with `engine` {self.name}")

    @property
    def kind(self) -> type[Engine]:
        """Return what is declared of the engine; raises UsageError for an unknown name."""
        return ENGINES[self.name]

    @property
    def of_model(self) -> str:
        """Return the first option that only an engine with a model can honour, or nothing."""
        fields = type(self).model_fields
        return next((name for name in OF_MODEL if getattr(self, name) != fields[name].default), "")

    def default_name(self, say: Callable[[str], None]) -> str:
        """Return llama where it is installed, or a model is named; else echo, and ``say`` so."""
        if self.of_model or extras.installed("llama_cpp"):
            return MODEL
        missing = extras.how_to_install("llama")
        say(f"no llama-cpp-python here, so the echo engine answers, without a model; {missing}")
        return STAND_IN

    @property
    def chunks(self) -> bool:
        return self.answer == "actions"

    @property
    def pieces(self) -> str:
        return f"{self.horizon} actions of {self.action_dim}"


class _UndeclaredEngine(Engine):
    """What is assumed of who answered an old run, and is not here."""


def acting() -> str:
    """Name the engines that answer with actions, for errors."""
    return " or ".join(name for name, kind in ENGINES.loaded() if kind.acts)


@cache
def declared_engine(name: str) -> type[Engine]:
    """Return what is declared of an engine, for showing a run; one that is not installed is like any model's."""
    try:
        return ENGINES[name]
    except UsageError:
        return _UndeclaredEngine


def check_engine(config: EngineConfig) -> None:
    """Raise UsageError where an engine's own options, and the engine, do not go together."""
    for name, kind in ENGINES.loaded():
        given = next((option for option in kind.exclusive_options if getattr(config, option)), "")
        if given and name != config.name:
            raise UsageError(f"`{given}` needs `engine` {name}; `engine` {config.name} answers at its own speed")
    config.kind.check(config)


def need_engine(config: EngineConfig) -> None:
    """Raise MissingExtra, naming the model's option if one is given, where what an engine needs is not installed."""
    if not config.kind.needs:
        return
    try:
        extras.need(*config.kind.needs)
    except MissingExtra as error:
        raise MissingExtra(f"`{config.of_model}`: {error}" if config.of_model else str(error)) from error


def cancel(tokens: object) -> None:
    """Cancel what an engine's iterator has not yielded."""
    close = getattr(tokens, "close", None)
    if close is not None:
        close()


class PacedEngine(Engine):
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
            cancel(tokens)

    def describe(self) -> dict[str, str | int | float | bool]:
        return {**self._engine.describe(), "paced_tokens_per_s": self._rate}

    def close(self) -> None:
        self._engine.close()


def open_engine(config: EngineConfig, beside: Engine | None = None) -> Engine:
    """Start the engine that ``config`` names; raises UsageError for an unknown name, EngineError otherwise.

    ``beside`` is one like it in this process, which takes turns with it and is closed after it.
    """
    engine = config.kind(config) if beside is None else beside.open_beside(config)
    if config.pace:
        return PacedEngine(engine, config.pace)
    return engine


@lru_cache(8)
def swing(horizon: int, dims: int, seed: int) -> NDArray[np.float32]:
    """Return sines of amplitude 1, a phase for each joint and seed: float32 (horizon, dims)."""
    import numpy as np

    ticks, joints = np.arange(horizon)[:, None], np.arange(dims)[None, :]
    values = np.sin(tau * (ticks + seed) / PERIOD + joints).astype(np.float32)
    values.flags.writeable = False
    return values


def chunk(config: EngineConfig, request: Request) -> Iterator[Action]:
    """Yield the actions of an engine without a policy: smooth motion, as many as it is told and as a request takes."""
    values = swing(config.horizon, config.action_dim, request.seed)
    for index in range(max(0, min(config.horizon, request.max_tokens))):
        yield Action(index, values[index])


Size: TypeAlias = Literal["tiny", "full"]
Quant: TypeAlias = Literal["f16", "q8_0", "q4_0"]
"""Of dummy weights."""


class FetchConfig(Options):
    """Which model is fetched."""

    what: str = option(..., "minicpm-v-2.6, or ORG/REPO:FILE", flag="name", argument=True)
    quant: str | None = option(None, "quantisation of the language model, as Q8_0 [default: Q4_K_M]")
    mmproj: str | None = option(None, "the repository's vision tower to fetch too [default: the known one, or none]")


class InfoConfig(Options):
    """Which file is looked into."""

    what: str = option(..., "a GGUF file, or minicpm-v-2.6 once it is fetched", flag="file", argument=True)
    hash: bool = option(False, "compute the SHA-256; else it is shown where it is known already")


class DummyConfig(Options):
    """Which dummy weights are written, and where."""

    size: Size = option("tiny", "tiny: 13 MB, for tests; full: the shapes of MiniCPM-V 2.6")
    quant: Quant | None = option(
        None, "type of the language model's weights: f16, q8_0, q4_0 [default: f16 (tiny), q4_0 (full)]"
    )
    output: Path | None = option(None, "folder to write to [default: the user's cache folder]")
    force: bool = option(False, "write the files again if they are there")

    @property
    def kind(self) -> Quant:
        return self.quant or ("q4_0" if self.size == "full" else "f16")
