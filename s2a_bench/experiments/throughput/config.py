"""What a throughput run is asked: requests, an engine that computes, and a reference beside it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import field_validator

from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import FirstVariants, RequestsConfig
from s2a_bench.inference import ANSWERS, ENGINES, EngineConfig
from s2a_bench.options import Names, group, one_of, option
from s2a_bench.transport.http import HTTP, LLAMA_SERVER
from s2a_bench.transport.loopback import LOOPBACK

IN_PROCESS: Final = "in-process"
"""What this command calls the transport `loopback`: here it is the engine that is looked at, not the way to it."""


TWIN: Final = "llama-server"
"""What `engine` may be here besides: llama.cpp's own server, beside the engine in this process on the same files."""
TWINS: Final = (IN_PROCESS, f"{HTTP.name}/{LLAMA_SERVER}")


class ThroughputEngine(EngineConfig):
    """The engine, among those that compute."""

    name: Annotated[str, one_of(lambda: ENGINES)] = option(
        "llama",
        f"{', '.join(name for name in ENGINES if name != 'echo')}, {TWIN}; replay plays --profile (EMULATED), {TWIN} "
        "is llama.cpp's own, in turn with llama in this process",
        flag="engine",
    )


class ThroughputConfig(RequestsConfig):
    """The settings of a throughput run."""

    QUICK: ClassVar[dict[str, int]] = {"runs": 3, "warmup": 1, "max_tokens": 32}

    transports: Names = option(
        (IN_PROCESS,), "in-process, http, ros, as in latency; several with commas", flag="transport"
    )
    variants: FirstVariants = group(FirstVariants)
    engine: ThroughputEngine = group(
        ThroughputEngine, only=set(EngineConfig.model_fields) - {"pace", "latency", *ANSWERS}
    )
    runs: int = option(10, "requests a cell [default: 10, quick: 3]", ge=1, le=10**9)
    warmup: int = option(2, "warm-ups a cell, kept and marked [default: 2, quick: 1]", ge=0, le=10**9)
    max_tokens: int = option(128, "tokens an answer [default: 128, quick: 32]", ge=1, le=2**20)
    reference: Path | None = option(
        None, "llama.cpp's llama-bench, run in turn with ours on the same model file, which takes --sampling greedy"
    )

    def __init__(self, **given: Any) -> None:
        """Keep what is given, `TWINS` for the engine of that name; raises UsageError naming the field."""
        engine = given.get("engine")
        if isinstance(engine, Mapping) and engine.get("name") == TWIN:
            if "transports" in given:
                raise UsageError(f"`engine` {TWIN} is `transport` {','.join(TWINS)}; leave one of them out")
            given = {**given, "engine": {**engine, "name": "llama"}, "transports": TWINS}
        super().__init__(**given)

    @field_validator("engine", mode="before")
    @classmethod
    def _of_any_command(cls, engine: Any) -> Any:
        return engine.model_dump(include=engine.model_fields_set) if isinstance(engine, EngineConfig) else engine

    @property
    def names(self) -> Sequence[str]:
        """Return pipeline names, ``in-process`` by that of its transport."""
        return [LOOPBACK.name if name == IN_PROCESS else name for name in self.transports]

    @property
    def greedy(self) -> bool:
        """Whether the likeliest token is taken: beside a reference, which samples nothing, unless told."""
        told = "sampling" in self.engine.model_fields_set or self.reference is None
        return self.engine.sampling == "greedy" if told else True

    def check(self) -> None:
        """Raise UsageError, naming the field, for a combination that makes no sense."""
        super().check()
        if self.max_tokens < 2:  # noqa: PLR2004 - a rate needs two tokens
            raise UsageError("`max_tokens`: a rate needs 2 tokens or more")
        if self.engine.name == "echo":
            raise UsageError("`engine` echo computes nothing; `engine` llama or replay has tokens a second")
        if self.foreign and self.greedy:
            raise UsageError(f"`sampling` greedy is our own engine's; leave it out with `{self.foreign}`")
        if self.reference is None:
            return
        if not (self.reference.is_file() and os.access(self.reference, os.X_OK)):
            raise UsageError(f"`reference`: {self.reference} is no program that can be run")
        if self.engine.name != "llama":
            raise UsageError(f"`reference` runs a model file; leave out `engine` {self.engine.name}")
        if self.grammar:
            raise UsageError("`reference`: llama-bench knows no grammar; leave out `grammar`")
