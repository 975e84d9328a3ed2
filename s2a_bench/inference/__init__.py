"""Engines, which turn a request with RGB pictures into a stream of tokens or of actions; and their options."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from math import tau
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Protocol, TypeAlias, get_args

from pydantic import AfterValidator, BeforeValidator

from s2a_bench import extras
from s2a_bench.boards.profile import profile_files
from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import EngineError, MissingExtra, UsageError
from s2a_bench.facts import Fact
from s2a_bench.options import Options, one_of, option
from s2a_bench.policy.parameters import build
from s2a_bench.registry import Registry
from s2a_bench.text import none_of
from s2a_bench.types import Action, Piece, Request

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class NoParameters:
    """The parameters of most engines: none."""


class Engine(Protocol):
    """A model, or something that behaves like one. One request at a time; not thread-safe."""

    acts: ClassVar[bool] = False
    """Whether it can answer with actions."""
    needs_model: ClassVar[bool] = True
    """Whether it loads a model's files, by default the tiny dummy's: `OF_MODEL` are options of such engines."""
    computes: ClassVar[bool] = True
    """Whether its answers take a model's time, so that a rate, and a plan in them, have a meaning."""
    plays: ClassVar[tuple[str, int] | None] = None
    """The skill set and the tokens a skill of the plans that it plays; None: it plays no recording."""
    speaks: ClassVar[bool] = True
    """Whether it can answer with tokens."""
    parameters: ClassVar[type] = NoParameters
    """Dataclass of what its name may carry, ``name?parameter=value``, as policies have."""
    risk: ClassVar[str] = ""
    """``program`` if a parameter names code to run: a file from another person should not choose it."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The extra of this package that it needs, and the modules of that extra."""
    exclusive_options: ClassVar[tuple[str, ...]] = ()
    """The options that no other engine honours."""
    declared_facts: ClassVar[Sequence[Fact]] = ()
    honours: ClassVar[Sequence[str]] = ()
    """The names in `Request.sampling` that it honours."""
    _facts: dict[str, float] = {}  # noqa: RUF012 - replaced, never changed
    _closed: bool = False

    def __init__(self, config: EngineConfig) -> None:
        """Open the engine; raises EngineError, and UsageError for what `check` refuses."""

    @classmethod
    def check(cls, config: EngineConfig) -> None:  # noqa: ARG003 - for subclasses
        return

    @classmethod
    def facts_for(cls, config: EngineConfig) -> Sequence[Fact]:  # noqa: ARG003 - for subclasses
        """Return the facts that it reports under this configuration."""
        return cls.declared_facts

    def open_beside(self, config: EngineConfig) -> Engine:
        """Open an engine of this kind in this process, which takes turns with it and is closed before it."""
        return config.kind(config)

    @property
    def facts(self) -> dict[str, float]:
        """Return the declared facts about the last request, as llama.cpp's ``timings``."""
        return self._facts

    def generate(self, request: Request) -> Iterator[Piece]:
        """Yield the answer's pieces, at most ``request.max_tokens``; closing the iterator cancels the rest.

        Pictures are ``rgb8``. Raises EngineError for a request that cannot be answered (a bad grammar,
        a prompt longer than the context).
        """
        raise NotImplementedError

    def describe(self) -> dict[str, str | int | float | bool]:
        """Return facts for the manifest: engine, model file, hash, whether the weights are dummies."""
        raise NotImplementedError

    def need_open(self) -> None:
        """Raise EngineError after `close`."""
        if self._closed:
            raise EngineError(f"{self.describe()['engine']}: the engine is closed; open a new one")

    def close(self) -> None:
        """Free the model; may be called twice."""
        self._closed = True


ENGINES: Final[Registry[type[Engine]]] = Registry(
    "engines",
    "engine",
    {
        "llama": "s2a_bench.inference.one_thread:Llama",
        "echo": "s2a_bench.inference.echo:EchoEngine",
        "replay": "s2a_bench.inference.replay:ReplayEngine",
        "call": "s2a_bench.inference.call:CallEngine",
    },
)

MODEL, STAND_IN = "llama", "echo"
"""The default engine, and the one without its library."""

CHECKS: dict[str, str] = {"llama-build": "s2a_bench.inference.smoke:llama_build"}
"""Code -> ``module:function`` of the doctor's checks of engines."""

PERIOD = 50
"""Control ticks of one swing: a second at 50 Hz."""

ANSWERS: Final = ("answer", "horizon", "action_dim")
"""The options about the kind of an answer."""

OF_MODEL: Final = ("model", "mmproj", "chat_template", "gpu_layers")
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
"""The number of last tokens whose repetition is penalised: its name in `Request.sampling`, and its default."""

SAMPLER_ARGUMENTS = {
    **{name: name for name in ("temp", "top_k", "top_p", "min_p", "typical_p", "mirostat_eta", "mirostat_tau")},
    "mirostat": "mirostat_mode",
    "penalty_repeat": "repeat_penalty",
    "penalty_freq": "frequency_penalty",
    "penalty_present": "presence_penalty",
}
"""Name in `Request.sampling` -> the library's name."""

LEAST_CONTEXT, LEAST_BATCH, LARGEST = 256, 32, 1 << 20


def _check_engine(written: str) -> str:
    if (name := written.partition("?")[0]) not in ENGINES:
        raise ValueError(none_of(name, ENGINES))
    return written


def _written(value: Any) -> Any:
    return str(value) if isinstance(value, (int, float)) else value


Written = Annotated[str, BeforeValidator(_written, json_schema_input_type=str | float)]
"""A text, or a number."""


class EngineConfig(Options):
    PANEL: ClassVar[str] = "Model"

    name: Annotated[str, AfterValidator(_check_engine)] = option(
        MODEL,
        f"{', '.join(ENGINES)}; echo leaves the transport alone, replay plays --profile (EMULATED), "
        "call?function=MODULE:NAME is your own",
        flag="engine",
        first=True,
        names=lambda: ENGINES,
    )
    profile: str = option("", "what --engine replay plays: a name of 'profile list', or a path", names=profile_files)
    gaps: str = option("", "replay: trace, parametric, constant [default: trace if recorded]")
    latency: Written = option(
        "", "echo: time to the whole answer: ms, FAMILY:mean_ms=...,key=value, FILE.csv [default: at once]"
    )
    model: Path | None = option(None, "GGUF, name, or hub:OWNER/REPO[:FILE] [default: the tiny dummy]", first=True)
    mmproj: Path | None = option(None, "GGUF vision tower that goes with --model")
    chat_template: str = option("", "file of a Jinja template, or none: the raw prompt [default: the model's own]")
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
        if self.kv_type in {"q8_0", "q4_0"} and self.flash_attention == "off":
            raise UsageError(
                f"`kv_type` {self.kv_type} needs flash attention, which alone reads a quantised V cache; "
                "leave out `flash_attention` off"
            )
        if "name" not in self.model_fields_set:
            return
        build(self.kind.parameters, self.name, "engine")
        if self.chunks and not self.kind.acts:
            raise UsageError(f"`answer`: `engine` {self.name} answers with tokens alone; use `engine` {acting()}")
        if self.answer == "tokens" and not self.kind.speaks:
            raise UsageError(f"`answer` tokens: `engine` {self.name.partition('?')[0]} answers with actions alone")
        if self.of_model and not self.kind.needs_model:
            raise UsageError(f"`{self.of_model}` is for an engine with a model; leave it out with `engine` {self.name}")

    @property
    def kind(self) -> type[Engine]:
        return ENGINES[self.name.partition("?")[0]]

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        if self.kind.risk:
            yield "engine", self.kind.risk, self.name

    @property
    def of_model(self) -> str:
        """Return the first option that only an engine with a model can honour, or nothing."""
        fields = type(self).model_fields
        return next((name for name in OF_MODEL if getattr(self, name) != fields[name].default), "")

    def default_name(self, say: Callable[[str], None]) -> str:
        """Return llama if it is installed, or a model is named; else echo, and ``say`` so."""
        if self.of_model or extras.installed("llama_cpp"):
            return MODEL
        say(
            "llama-cpp-python is not installed, so the echo engine answers, without a model; "
            f"{extras.how_to_install('llama')}"
        )
        return STAND_IN

    @property
    def wanted(self) -> str:
        """Return `answer`; where the engine leaves no choice, what it answers with."""
        return self.answer if self.kind.speaks else "actions"

    @property
    def chunks(self) -> bool:
        return self.answer == "actions"

    @property
    def pieces(self) -> str:
        return f"{self.horizon} actions of {self.action_dim}"


def acting() -> str:
    return " or ".join(name for name, kind in ENGINES.loaded() if kind.acts)


def computing() -> str:
    return " or ".join(name for name, kind in ENGINES.loaded() if kind.computes)


@cache
def declared_engine(name: str) -> type[Engine]:
    """Return the class of a run's engine; one that is not installed counts as a model's."""
    try:
        return ENGINES[name]
    except UsageError:
        return Engine


def check_engine(config: EngineConfig) -> None:
    """Raise UsageError for an option of another engine, and for options that contradict each other."""
    for name, kind in ENGINES.loaded():
        option_name = next((option for option in kind.exclusive_options if getattr(config, option)), "")
        if option_name and name != config.name:
            raise UsageError(f"`{option_name}` needs `engine` {name}; `engine` {config.name} answers at its own speed")
    config.kind.check(config)


def need_engine(config: EngineConfig) -> None:
    """Raise MissingExtra, naming the model's option if one is given, if the engine's libraries are not installed."""
    if not config.kind.needs:
        return
    try:
        extras.need(*config.kind.needs)
    except MissingExtra as error:
        raise MissingExtra(f"`{config.of_model}`: {error}" if config.of_model else str(error)) from error


def cancel(tokens: object) -> None:
    if close := getattr(tokens, "close", None):
        close()


class PacedEngine(Engine):
    """Holds an engine's tokens back to a rate above 0.

    Token k leaves k / rate after the first one, or later, at once: deadlines count from the first token, so that late
    wake-ups do not add up.
    """

    def __init__(self, engine: Engine, tokens_per_s: float, clock: Clock | None = None) -> None:
        self._engine = engine
        self._rate = tokens_per_s
        self._clock = clock or SystemClock()

    @property
    def facts(self) -> dict[str, float]:
        return self._engine.facts

    def generate(self, request: Request) -> Iterator[Piece]:
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
    """Open the engine that ``config`` names; raises UsageError for an unknown name, EngineError otherwise.

    ``beside`` is an open engine in this process that takes turns with it and is closed after it.
    """
    engine = config.kind(config) if beside is None else beside.open_beside(config)
    return PacedEngine(engine, config.pace) if config.pace else engine


@lru_cache(8)
def swing(horizon: int, dims: int, seed: int) -> NDArray[np.float32]:
    """Return sines of amplitude 1, with a phase by joint and seed: float32 (horizon, dims)."""
    import numpy as np

    ticks, joints = np.arange(horizon)[:, None], np.arange(dims)[None, :]
    values = np.sin(tau * (ticks + seed) / PERIOD + joints).astype(np.float32)
    values.flags.writeable = False  # cached: requests share it
    return values


def chunk(config: EngineConfig, request: Request) -> Iterator[Action]:
    """Yield the actions of an engine without a policy: smooth motion, at most ``request.max_tokens``."""
    values = swing(config.horizon, config.action_dim, request.seed)
    for index in range(max(0, min(config.horizon, request.max_tokens))):
        yield Action(index, values[index])


Size: TypeAlias = Literal["tiny", "full"]
Like: TypeAlias = Literal["minicpm-v-2.6", "qwen2.5-vl-3b", "smolvlm2-500m", "gemma3-4b"]
Quant: TypeAlias = Literal["f16", "q8_0", "q4_0"]
"""The quantisation of dummy weights."""


class FetchConfig(Options):
    what: str = option(..., "a name of 'model list', or OWNER/REPO[:FILE]", flag="name", argument=True)
    quant: str | None = option(None, "quantisation of the language model, as F16 [default: Q4_K_M, else Q8_0]")
    mmproj: str | None = option(None, "the repository's vision tower [default: F16, else Q8_0; with FILE none]")


class DummyConfig(Options):
    like: Like = option("minicpm-v-2.6", f"the model to imitate: {', '.join(get_args(Like))}")
    size: Size = option("tiny", "tiny: some 10 MB, for tests; full: the model's shapes")
    quant: Quant | None = option(
        None, "type of the language model's weights: f16, q8_0, q4_0 [default: f16 (tiny), q4_0 (full)]"
    )
    output: Path | None = option(None, "folder to write to [default: the user's cache folder]")
    force: bool = option(False, "write the files again if they are there")

    @property
    def kind(self) -> Quant:
        return self.quant or ("q4_0" if self.size == "full" else "f16")
