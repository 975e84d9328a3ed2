"""The options of a CCRB run: policies, a board or a model, the scenario, a simulator."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, Final

from pydantic import Field

from s2a_bench.boards.profile import load_profile, profile_files
from s2a_bench.boards.tokens import NO_JITTER, PROMPT_TIME, Board, board_of_profile, board_of_rate
from s2a_bench.errors import UsageError
from s2a_bench.harness.config import GROUPED
from s2a_bench.harness.timelines.config import PlanRequests, PolicyOptions, check_steppers
from s2a_bench.inference import ENGINES
from s2a_bench.options import Numbers, Options, group, option
from s2a_bench.scenario import SIMULATORS, simulator_class
from s2a_bench.scenario.ccrb.options import SKILL_SET, CcrbOptions

LONG_S: Final = 600.0
BOARD: Final = "jetson-agx-orin"
TTC_POLICY: Final[Any] = option(False, "add s2a-ttc: stream-to-act that starts by the lead's deadline")
"""The option of roll-outs, whose arrivals are known beforehand."""


class CcrbDrives(PolicyOptions):
    """The drives; the defaults are an operating point with the paper's outcome."""

    PANEL: ClassVar[str] = "Drives"
    closed_loop: ClassVar[bool] = False
    """Whether the world runs while the plan arrives."""
    time: ClassVar[str] = "virtual"
    """The clock of the world."""
    PACED_BY: ClassVar[str]
    """The options that set the rate of the tokens."""

    tokens_per_skill: int = option(6, "L, the delimiter included", ge=1, le=1000)
    simulator: str = option(
        "longitudinal", f"{', '.join(SIMULATORS)}; or NAME?parameter=value", first=True, names=lambda: SIMULATORS
    )
    scenario: CcrbOptions = Field(default_factory=CcrbOptions)

    @property
    def board(self) -> Board:
        """Return the board whose tokens are expected."""
        raise NotImplementedError

    def check(self) -> None:
        world = simulator_class(self.simulator)
        if self.scenario.lane_change and not world.steers:
            raise UsageError(f"`lane_change`: the {world.name} simulator knows one lane; take `simulator` embedded")
        _ = self.named_policies
        whole_s = self.board.prompt_s + self.tokens_per_skill * (self.scenario.n_skills + 1) / self.board.tokens_per_s
        if whole_s > LONG_S:
            raise UsageError(
                f"{self.PACED_BY}: the whole plan takes {whole_s:.0f} s to arrive, which is too slow to drive; "
                f"at most {LONG_S:.0f} s"
            )

    def to_manifest(self) -> dict[str, Any]:
        fields = {**self.model_dump(exclude={"scenario", "requests"}), **self.scenario.to_manifest()}
        t_nom_s = self.scenario.durations.nominal_s
        return {**fields, "t_nom_s": t_nom_s, "closed_loop": self.closed_loop, "time": self.time}


class CcrbModelled(CcrbDrives):
    """Drives on a board's modelled tokens."""

    PACED_BY: ClassVar[str] = "`rate` or `profile`"
    virtual: ClassVar[bool] = True

    profile: str = option(BOARD, "the board, or what replay plays: a name, or a path", first=True, names=profile_files)
    rate: float | None = option(None, "a board of which only the tokens/s are known", gt=0, allow_inf_nan=False)
    prompt_s: float | None = PROMPT_TIME

    @cached_property
    def board(self) -> Board:
        if self.rate is not None:
            return board_of_rate(self.rate, NO_JITTER, self.prompt_s)
        return board_of_profile(load_profile(self.profile), NO_JITTER, self.prompt_s)


class CcrbComputed(CcrbModelled):
    """Roll-outs on modelled tokens, and the studies of their ordering."""

    ttc: bool = TTC_POLICY
    phase: bool = option(False, "also the phase diagram over rate and rear gap, for every gap behaviour", first=True)
    phase_rates: Numbers = option((2.0, 12.0), "tokens/s of the phase diagram: from, to")
    phase_gaps_m: Numbers = option((6.0, 30.0), "m to the car behind in the phase diagram: from, to", flag="phase-gaps")
    phase_points: tuple[int, int] = option((41, 25), "rates and gaps of the phase diagram", hidden=True)
    random: int = option(0, "also as many random scenarios; 0: none", ge=0, le=100_000)

    def check(self) -> None:
        super().check()
        for name, span, most in (("phase_rates", self.phase_rates, 10_000), ("phase_gaps_m", self.phase_gaps_m, 1000)):
            if len(span) != 2 or not 0 < span[0] < span[1] <= most:  # noqa: PLR2004 - from, to
                raise UsageError(f"`{name}`: should be two numbers above 0 and at most {most:g}, the lower first")


class CcrbClosedLoop(CcrbModelled):
    """A world that runs, in virtual time, while modelled tokens arrive."""

    closed_loop: ClassVar[bool] = True


class DrivingRequests(PlanRequests):
    """The requests for plans about the simulator's view; a replay plays the usual board unless another is named."""

    def __init__(self, **values: Any) -> None:
        engine = values.get("engine") or {}
        engine = engine.given_values() if isinstance(engine, Options) else engine
        name = engine.get("name", "")
        if name in ENGINES and ENGINES[name].plays and not engine.get("profile"):
            values["engine"] = {**engine, "profile": BOARD}
        super().__init__(**values)


class CcrbRequested(CcrbDrives):
    """Drives on the tokens of a model."""

    PACED_BY: ClassVar[str] = "`pace` or `profile`"
    requests: DrivingRequests = group(
        DrivingRequests, only=(*(each for each in GROUPED if each != "source"), "record"), first=()
    )

    @property
    def skill_set(self) -> str:
        played = self.requests.engine.kind.plays
        return played[0] if played else SKILL_SET

    @cached_property
    def board(self) -> Board:
        engine = self.requests.engine
        if engine.pace is not None:
            return board_of_rate(engine.pace, NO_JITTER, None)
        return board_of_profile(load_profile(engine.profile or BOARD), NO_JITTER, None)

    def check(self) -> None:
        check_steppers(self.named_policies.values())
        self.requests.require_played(self.skill_set, (self.tokens_per_skill,), "`tokens_per_skill`")
        super().check()


class CcrbLive(CcrbRequested):
    """Roll-outs on the arrivals of a model's plan."""

    ttc: bool = TTC_POLICY


class CcrbLiveLoop(CcrbRequested):
    """A world that runs on the clock while a model's plan arrives."""

    closed_loop: ClassVar[bool] = True
    time: ClassVar[str] = "monotonic"

    ego: str = option("", "ros[?parameter=value&...]: command and see the ego over ROS 2, if the simulator can")

    def check(self) -> None:
        super().check()
        if self.ego:
            from s2a_bench.scenario.ros import ego_parameters

            ego_parameters(self.ego, simulator_class(self.simulator))
