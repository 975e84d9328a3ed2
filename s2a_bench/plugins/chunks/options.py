"""The options of robots that act on chunks of actions, and those of their requests to a server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, Field

from s2a_bench import extras
from s2a_bench.harness.config import GROUPED, FirstVariants, sampling
from s2a_bench.inference import STAND_IN, EngineConfig, Written
from s2a_bench.options import Names, Options, group, option
from s2a_bench.plugins.chunks.latencies import Source, sources, split
from s2a_bench.plugins.chunks.modes import COMPARED, MODES, ControlSetting, Mode, Rounding, modes
from s2a_bench.transport import ACTIONS, TRANSPORTS

WITHOUT_PACKAGES: Final = "http/binary"
"""The transport of a control loop, where no transport of actions alone is installed with its packages."""

Sources = Annotated[
    tuple[str, ...], Field(min_length=1), BeforeValidator(split, json_schema_input_type=tuple[str | float, ...])
]
"""Sources of latencies; as text they are separated by commas, and so are the parameters of a family."""


def acting_modes(default: tuple[str, ...]) -> Any:
    about = f"{', '.join(MODES)}, each with ?parameter=value&...; several with commas"
    return option(default, about, first=True, min_length=1, names=lambda: MODES)


def acting_over() -> tuple[str, str]:
    """Return the transport of a control loop, and in words: the first that serves actions alone, in their order."""
    for name, each in TRANSPORTS.loaded():
        if each.serves and each.answer_kinds == (ACTIONS,):
            installed = all(map(extras.installed, each.needs[1:]))
            words = f"{name}, {WITHOUT_PACKAGES} where its packages are not installed"
            return name if installed else WITHOUT_PACKAGES, words
    return WITHOUT_PACKAGES, WITHOUT_PACKAGES


@dataclass(frozen=True, slots=True)
class ControlPlan:
    """The acting modes of the robots, by their canonical names, under one control clock."""

    setting: ControlSetting
    modes: Mapping[str, Mode]
    seed: int


class ControlOptions(Options):
    """How robots act on chunks of actions."""

    PANEL: ClassVar[str] = "Control loop"

    modes: Names = acting_modes(COMPARED)
    control_hz: float = option(50.0, "control ticks a second", ge=1e-3, le=10_000, allow_inf_nan=False, first=True)
    horizon: int = option(16, "H, actions of a chunk", ge=1, le=4096, first=True)
    rounding: Rounding = option("floor", "d is the floor or ceil of latency over control tick")
    seed: int = option(0, "seed of everything that is drawn", ge=0)

    @property
    def setting(self) -> ControlSetting:
        return ControlSetting(round(1e9 / self.control_hz), self.horizon, self.rounding)

    @cached_property
    def control(self) -> ControlPlan:
        return ControlPlan(self.setting, modes(self.modes, self.setting), self.seed)

    def check(self) -> None:
        self.check_modes()

    def check_modes(self) -> None:
        """Raise UsageError for an unknown acting mode, and for one that cannot act so."""
        _ = self.control

    def to_manifest(self) -> dict[str, Any]:
        fields = self.model_dump(mode="json", exclude={"requests"})
        return {**fields, "modes": list(self.control.modes), "period_ns": self.setting.period_ns}


class GivenLatencies(ControlOptions):
    """Robots whose requests take given latencies, in virtual time."""

    virtual: ClassVar[bool] = True

    latency: Sources
    tokens_per_action: int = option(7, "tokens of an action, where a profile answers", ge=1, le=1000)

    @cached_property
    def sources(self) -> tuple[Source, ...]:
        tokens = self.horizon * self.tokens_per_action
        return tuple(source for written in self.latency for source in sources(written, tokens))


class LoopRequests(FirstVariants):
    """The requests of control loops."""

    COUNTS_TOKENS: ClassVar[str] = ""

    transports: Names = option(
        (acting_over()[0],),
        f"transports as in latency; several with commas, each with every mode [default: {acting_over()[1]}]",
        flag="transport",
    )
    engine: EngineConfig = group(EngineConfig, only=("name", "profile", "gaps", "action_dim"))
    warmup: int = option(5, "requests before a cell's loop starts, kept and marked", ge=1, le=10**6)
    sample_resources_hz: float = sampling(0.0)


class ServedOptions(ControlOptions):
    """Robots that act on the answers of a server."""

    latency: Written = option(
        "", "how long echo takes to answer: ms, FAMILY:mean_ms=...,key=value, FILE.csv [default: no time]", first=True
    )
    requests: LoopRequests = group(LoopRequests, only=(*GROUPED, "prompt"), first=("transports",))

    @property
    def answer(self) -> str:
        """The kind of the server's answers."""
        return ACTIONS

    @cached_property
    def robots_requests(self) -> LoopRequests:
        """The requests that robots make; with a latency, an engine that is not named is echo."""
        engine: dict[str, Any] = {"answer": self.answer, "horizon": self.horizon}
        if self.latency:
            engine["latency"] = self.latency
            engine |= {} if self.requests.engine.model_fields_set else {"name": STAND_IN}
        return self.requests.but(engine=self.requests.engine.but(**engine), seed=self.seed, requests=1)

    def check(self) -> None:
        super().check()
        _ = self.robots_requests  # raises UsageError
