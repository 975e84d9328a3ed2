"""The options of a CCRB run: policies, a board or a model, the scenario, a simulator."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final

from pydantic import Field

from s2a_bench.boards.profile import profile_files
from s2a_bench.boards.tokens import PROMPT_TIME
from s2a_bench.errors import UsageError
from s2a_bench.harness import RECORD
from s2a_bench.harness.timelines.config import TimelineConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, Numbers, Options, group, option
from s2a_bench.policy import COMPARED, POLICIES
from s2a_bench.scenario import SIMULATORS, simulator_class
from s2a_bench.scenario.ccrb.options import SKILL_SET, CcrbOptions
from s2a_bench.transport import paths


class PlanRequest(Options):
    """The model of a live run and its transport."""

    PANEL: ClassVar[str] = "A model that answers"

    live: bool = option(False, "take the tokens of a model that really answers, about the rendered scene", first=True)
    transport: str = option(
        "", "--live: ros, ros/action, http, http/VARIANT, shm, loopback [default: ros]", names=paths
    )
    engine: EngineConfig = group(
        EngineConfig, only=("name", "model", "mmproj", "chat_template", "threads", "pace"), about="--live: ", first=()
    )
    record: Path | None = RECORD

    def check(self) -> None:
        for name in () if self.live else self.given():
            if name != "live":
                raise UsageError(f"`{name}` is about a model that answers; it needs `live`")


LONG_S: Final = 600.0
SPANS: Final = {"phase_rates": 10_000.0, "phase_gaps_m": 1000.0}
"""Fields with a span (from, to) -> its greatest end."""
MODELLED: Final = ("rate", "prompt_s", "phase", "random")
"""Fields of modelled tokens, besides the profile: refused with `live`."""


class CcrbConfig(Options):
    """What is driven; the defaults are an operating point with the paper's outcome."""

    PANEL: ClassVar[str] = "Drives"

    policies: Names = option(
        COMPARED,
        f"{', '.join(POLICIES)}, with parameters as in NAME?parameter=value&other=value; several with commas",
        flag="policy",
        first=True,
        names=lambda: POLICIES,
    )
    profile: str = option(
        "jetson-agx-orin", "the board: a name of 'profile list', or a path", first=True, names=profile_files
    )
    rate: float | None = option(None, "a board of which only the tokens/s are known", gt=0, allow_inf_nan=False)
    prompt_s: float | None = PROMPT_TIME
    tokens_per_skill: int = option(6, "L, the delimiter included", ge=1, le=1000)
    scenario: CcrbOptions = Field(default_factory=CcrbOptions)
    simulator: str = option(
        "longitudinal", f"{', '.join(SIMULATORS)}; or NAME?parameter=value", first=True, names=lambda: SIMULATORS
    )
    ego: str = option("", "ros[?parameter=value&...]: command and see the ego over ROS 2, if the simulator can")
    closed_loop: bool = option(
        False, "let the world run while the plan arrives: with --live on the clock, else in virtual time", first=True
    )
    ttc: bool = option(False, "add s2a-ttc: stream-to-act that starts by the lead's deadline")
    phase: bool = option(False, "also the phase diagram over rate and rear gap, for every gap behaviour", first=True)
    phase_rates: Numbers = option((2.0, 12.0), "tokens/s of the phase diagram: from, to")
    phase_gaps_m: Numbers = option((6.0, 30.0), "m to the car behind in the phase diagram: from, to", flag="phase-gaps")
    phase_points: tuple[int, int] = option((41, 25), "rates and gaps of the phase diagram", hidden=True)
    random: int = option(0, "also as many random scenarios; 0: none", ge=0, le=100_000)
    seed: int = option(0, "seed of everything that is drawn", ge=0)
    plan_request: PlanRequest = Field(default_factory=PlanRequest)

    @property
    def virtual(self) -> bool:
        return not self.plan_request.live

    @cached_property
    def timeline(self) -> TimelineConfig:
        """The timeline run with the same plans: one setting, even tokens."""
        durations, rate = (
            self.scenario.durations,
            self.plan_request.engine.pace if self.plan_request.live else self.rate,
        )
        return TimelineConfig(
            policies=self.policies,
            profiles=() if rate is not None else (self.profile,),
            rates=(rate,) if rate is not None else (),
            prompt_s=self.prompt_s,
            tokens_per_skill=(self.tokens_per_skill,),
            n_skills=(self.scenario.skills,),
            t_nom_s=(durations.nominal_s,),
            t_min=durations.least_s / durations.nominal_s,
            t_max=durations.most_s / durations.nominal_s,
            seed=self.seed,
        )

    @cached_property
    def request(self) -> TimelineConfig:
        """The live timeline whose one plan is driven; raises UsageError naming the field."""
        plan_request = self.plan_request
        played = plan_request.engine.kind.plays
        skills, tokens = played or (SKILL_SET, self.tokens_per_skill)
        if self.tokens_per_skill != tokens:
            raise UsageError(
                f"`engine` {plan_request.engine.name} writes {tokens} tokens a skill; leave out `tokens_per_skill`"
            )
        return TimelineConfig(
            live=True,
            transport=plan_request.transport,
            engine=plan_request.engine,
            profiles=(self.profile,) if played else (),
            skills=skills,
            policies=self.policies,
            tokens_per_skill=(self.tokens_per_skill,),
            n_skills=(self.scenario.skills,),
            seed=self.seed,
        )

    def check(self) -> None:
        for name, most in SPANS.items():
            span = getattr(self, name)
            if len(span) != 2 or not 0 < span[0] < span[1] <= most:  # noqa: PLR2004 - from, to
                raise UsageError(f"`{name}`: should be two numbers above 0 and at most {most:g}, the lower first")
        world = simulator_class(self.simulator)
        if self.scenario.lane_change and not world.steers:
            raise UsageError(f"`lane_change`: the {world.name} simulator knows one lane; take `simulator` embedded")
        if self.ego:
            from s2a_bench.scenario.ros import ego_parameters

            ego_parameters(self.ego, world)
            if not (self.closed_loop and self.plan_request.live):
                raise UsageError("`ego`: ROS 2 runs on the clock; it needs `closed_loop` and `live`")
        for name in ("ttc", "phase", "random") if self.closed_loop else ():
            if getattr(self, name):
                raise UsageError(f"`{name}` needs all arrivals beforehand, in virtual time; leave out `closed_loop`")
        if self.plan_request.live:
            self._check_live()
        self.timeline.check()
        self._check_length()

    def risks(self) -> Iterator[tuple[str, str, str]]:
        return self.request.risks() if self.plan_request.live else super().risks()

    def to_manifest(self) -> dict[str, Any]:
        modelled = {"profile", *MODELLED, "phase_rates", "phase_gaps_m", "phase_points"}
        left_out = {"scenario", "plan_request"} | (modelled if self.plan_request.live else set())
        given = {**self.model_dump(exclude=left_out), **self.scenario.to_manifest()}
        time = "monotonic" if self.closed_loop and self.plan_request.live else "virtual"
        return {**given, "t_nom_s": self.scenario.durations.nominal_s, "time": time}

    def _check_live(self) -> None:
        for name in MODELLED if self.plan_request.engine.kind.plays else (*MODELLED, "profile"):
            if getattr(self, name) != type(self).model_fields[name].default:
                raise UsageError(f"`{name}` is about tokens that are modelled; leave it out with `live`")
        _ = self.request

    def _check_length(self) -> None:
        board = self.timeline.boards[0]
        whole_s = board.prompt_s + self.tokens_per_skill * (self.scenario.n_skills + 1) / board.tokens_per_s
        if whole_s > LONG_S:
            raise UsageError(
                f"`rate`, `pace` or `profile`: the whole plan takes {whole_s:.0f} s to arrive, "
                f"which is no driving; at most {LONG_S:.0f} s"
            )
