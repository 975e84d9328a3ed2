"""What a run of requests is asked to do, checked, and the pipelines that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.replay import check_replay
from s2a_bench.trace import path_of
from s2a_bench.transport import TRANSPORTS, Transport
from s2a_bench.transport.options import checked
from s2a_bench.transport.pipeline import Pipeline, pipelines, require_payload

LARGEST = 16_384
MODES = ("request", "stream")

DEFAULT_PROMPT = """You are a robot task planner.
Skills: go_to(location), open(object), close(object), pick(object), place(object, location).
Rules: Output only numbered skill calls, one per line.
Do not output any explanation."""
"""The paper's prompt (section IV-E)."""


@dataclass(frozen=True)
class LatencyConfig:
    """The settings of one run of requests, as the flags of the same names give them."""

    transports: tuple[str, ...] = ("http", "ros")
    """Pipeline names: ``transport[/variant][?option=value&...]``."""
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Transport -> the variants to measure where its name has none; those it measures by default unless told."""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Transport -> option -> value, for the names that do not say it themselves."""
    payload: str = ""
    """How pictures travel over every transport; empty: each its own way."""
    tuned: bool = True
    """Whether this process and the servers keep large blocks of memory for the next picture."""
    record: Path | None = None
    """Where what travelled is recorded as MCAP."""
    source: str = "synthetic"
    width: int = 640
    height: int = 480
    engine: EngineConfig = field(default_factory=EngineConfig)
    runs: int = 50
    warmup: int = 5
    mode: str = "request"
    fps: float = 30.0
    max_tokens: int = 32
    prompt: str = DEFAULT_PROMPT
    grammar: str = ""
    seed: int = 0
    timeout_s: float = 300.0
    sample_resources_hz: float = 10.0
    """How often CPU, memory, GPU and power are read beside the run; 0: never."""

    @cached_property
    def pipelines(self) -> list[Pipeline]:
        """Return what is compared, a cell each; raises UsageError."""
        return pipelines(self.transports, {**self.options, "": {"payload": self.payload}}, self.variants)

    @property
    def used(self) -> list[Transport[Any]]:
        """Return the transports, each once."""
        return list({pipeline.transport.name: pipeline.transport for pipeline in self.pipelines}.values())

    @property
    def stages(self) -> dict[str, str]:
        """Return stage -> group of the transports, in the order of the path."""
        return path_of(transport.stages for transport in self.used)

    @property
    def packages(self) -> list[str]:
        """Return the packages whose versions belong beside the results of the transports."""
        return [package for transport in self.used for package in transport.packages]

    @property
    def own_engine(self) -> bool:
        """Whether an engine of ours answers over any transport."""
        return not all(pipeline.black_box for pipeline in self.pipelines)

    @property
    def foreign(self) -> str:
        """Return the first option that says that a server is not ours, or nothing."""
        found = (pipeline.transport.foreign_by(pipeline.options) for pipeline in self.pipelines)
        return next((name for name in found if name), "")

    def check(self) -> None:
        """Raise UsageError, naming the field, for a value or combination that makes no sense."""
        if not self.transports:
            raise UsageError(f"`transport`: name at least one of {', '.join(TRANSPORTS)}")
        _one_of("mode", self.mode, MODES)
        for name, value, least, most in (
            ("runs", self.runs, 1, 10**9),
            ("warmup", self.warmup, 0, 10**9),
            ("max_tokens", self.max_tokens, 1, 2**20),
            ("seed", self.seed, 0, 2**31 - 1),
            ("timeout", self.timeout_s, 0.1, 86_400),
            ("fps", self.fps, 0.1, 1_000),
            ("sample_resources", self.sample_resources_hz, 0, 1_000),
        ):
            if not least <= value <= most:
                raise UsageError(f"`{name}`: {value} is not between {least} and {most}")
        if not (16 <= self.width <= LARGEST and 16 <= self.height <= LARGEST) or self.width % 2:  # noqa: PLR2004
            raise UsageError(
                f"`size`: {self.width}x{self.height} should be 16x16 to {LARGEST}x{LARGEST}, of even width"
            )
        for name, text in (("prompt", self.prompt), ("grammar", self.grammar)):
            if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
                raise UsageError(f"`{name}`: the text is not valid UTF-8, or has a NUL")
        check_replay(self.engine)
        if self.record is not None and self.record.exists():
            raise UsageError(f"`record`: {self.record} exists already and is not overwritten; name another")
        for pipeline in self.pipelines:
            self._check(pipeline)
        if self.engine.name == "replay" and self.foreign:
            raise UsageError(f"`engine` replay needs our own servers; leave out `{self.foreign}`")
        self._check_unused()

    def _check(self, pipeline: Pipeline) -> None:
        """Check one cell against the settings of the run."""
        pipeline.transport.check(pipeline.variant, pipeline.options, mode=self.mode, engine=self.engine.name)
        require_payload(pipeline)
        if self.mode == "stream" and pipeline.payload == "jpeg-preencoded":
            raise UsageError("`payload` jpeg-preencoded has no meaning in `mode` stream; use jpeg")

    def _check_unused(self) -> None:
        """Refuse a server of somebody else's that nobody would ask."""
        for name in self.options.keys() - {transport.name for transport in self.used}:
            transport = TRANSPORTS[name]
            if field_ := transport.foreign_by(checked(transport.options, self.options[name], name)):
                raise UsageError(f"`{field_}` needs {name} among `transport`")

    def to_manifest(self) -> dict[str, Any]:
        """Return the settings as plain data, with what every pipeline came to be told."""
        told = {each.name: each.options.model_dump(mode="json", exclude_defaults=True) for each in self.pipelines}
        size = f"{self.width}x{self.height}"
        return {**asdict(self), "engine": self.engine.to_manifest(), "pipelines": told, "size": size}


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise UsageError(f"`{name}`: '{value}' is none of {', '.join(known)}")
