"""The options of a throughput run: requests, an engine that computes, and a reference program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import AfterValidator, field_validator

from s2a_bench.errors import UsageError
from s2a_bench.harness.config import FirstVariants
from s2a_bench.inference import ANSWERS, ENGINES, FLASH_ATTENTION, MODEL, EngineConfig
from s2a_bench.options import Names, group, listed, need_program, one_of, option
from s2a_bench.text import none_of
from s2a_bench.transport.defaults import LLAMA_SERVER, LOOPBACK

IN_PROCESS: Final = "in-process"
"""The name of the transport `loopback` in this command, which measures the engine."""
TWIN: Final = "llama-server"
"""An additional `engine`: llama.cpp's server beside the engine in this process, on the same files."""
TWINS: Final = (IN_PROCESS, LLAMA_SERVER)


def _check_settings(written: str) -> str:
    for setting in listed(written) or ("",):
        if setting not in FLASH_ATTENTION:
            raise ValueError(none_of(setting, FLASH_ATTENTION))
    return ",".join(listed(written))


class ThroughputEngine(EngineConfig):
    """The engine, among those that compute."""

    name: Annotated[str, one_of(lambda: ENGINES)] = option(
        MODEL,
        f"{', '.join(name for name, kind in ENGINES.loaded() if kind.computes)}, {TWIN}; replay plays --profile "
        f"(EMULATED), {TWIN} is llama.cpp's own, in turn with llama in this process",
        flag="engine",
    )
    flash_attention: Annotated[str, AfterValidator(_check_settings)] = option(
        "auto", "auto (llama.cpp's own choice), on, off; several with commas, each in cells of its own"
    )


class ThroughputConfig(FirstVariants):
    QUICK: ClassVar[dict[str, int]] = {"requests": 3, "warmup": 1, "max_tokens": 32}
    OF_ENGINE: ClassVar[tuple[str, ...]] = ("flash_attention",)
    COMPUTES: ClassVar[str] = "this command measures tokens a second"

    transports: Names = option(
        (IN_PROCESS,), "in-process, http, ros, as in latency; several with commas", flag="transport"
    )
    engine: ThroughputEngine = group(
        ThroughputEngine, only=set(EngineConfig.model_fields) - {"pace", "latency", *ANSWERS}
    )
    requests: int = option(10, "requests a cell [default: 10, quick: 3]", ge=1, le=10**9)
    warmup: int = option(2, "warm-ups a cell, kept and marked [default: 2, quick: 1]", ge=0, le=10**9)
    max_tokens: int = option(128, "tokens an answer [default: 128, quick: 32]", ge=1, le=2**20)
    reference: Path | None = option(
        None,
        "llama.cpp's llama-bench, run in turn with ours on the same model file, which takes --sampling greedy",
        risk="program",
    )

    def __init__(self, **values: Any) -> None:
        """Replace the engine `TWIN` by the transports `TWINS`; raises UsageError naming the field."""
        engine = values.get("engine")
        if isinstance(engine, Mapping) and engine.get("name") == TWIN:
            if "transports" in values:
                raise UsageError(f"`engine` {TWIN} is `transport` {','.join(TWINS)}; leave one of them out")
            values = {**values, "engine": {**engine, "name": MODEL}, "transports": TWINS}
        super().__init__(**values)

    @field_validator("engine", mode="before")
    @classmethod
    def _of_any_command(cls, engine: Any) -> Any:
        return engine.model_dump(include=engine.model_fields_set) if isinstance(engine, EngineConfig) else engine

    @property
    def names(self) -> Sequence[str]:
        """Pipeline names, with the transport of ``in-process``, each with every setting of flash attention."""
        written = (name.partition("?") for name in self.transports)
        names = [f"{LOOPBACK if path == IN_PROCESS else path}{mark}{query}" for path, mark, query in written]
        settings = listed(self.engine.flash_attention)
        if len(settings) == 1:
            return names
        return [f"{name}{'&' if '?' in name else '?'}flash_attention={each}" for name in names for each in settings]

    @property
    def greedy(self) -> bool:
        """Whether sampling is greedy: by default with a reference, which samples nothing."""
        by_user = "sampling" in self.engine.model_fields_set or self.reference is None
        return self.engine.sampling == "greedy" if by_user else True

    @property
    def reads_model(self) -> bool:
        return self.reference is not None or super().reads_model

    def check(self) -> None:
        super().check()
        if self.max_tokens < 2:  # noqa: PLR2004 - a rate needs two tokens
            raise UsageError("`max_tokens`: a rate needs 2 tokens or more")
        named = "," in self.engine.flash_attention or any(each.engine for each in self.pipelines)
        if named and not self.engine.kind.needs_model:
            raise UsageError(f"`engine` {self.engine.name} knows no flash attention; leave out `flash_attention`")
        if self.foreign and self.greedy:
            raise UsageError(f"`sampling` greedy is our own engine's; leave it out with `{self.foreign}`")
        if self.reference is None:
            return
        need_program("reference", self.reference)
        if not self.engine.kind.needs_model:
            raise UsageError(f"`reference` runs a model file; leave out `engine` {self.engine.name}")
        if named:
            raise UsageError("`reference` runs with one `flash_attention` at a time; name it by its flag")
        if self.grammar:
            raise UsageError("`reference`: llama-bench knows no grammar; leave out `grammar`")
