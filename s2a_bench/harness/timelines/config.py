"""The options of a timeline run: policies on boards, granularities, lengths and durations; and their checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

from pydantic import Field

from s2a_bench.act import ROBOTS, SkillKind, kind
from s2a_bench.boards.profile import load_profile, profile_files
from s2a_bench.boards.tokens import NO_JITTER, PROMPT_TIME, Board, board_of_profile, board_of_rate
from s2a_bench.errors import UsageError
from s2a_bench.frames import SOURCES
from s2a_bench.inference import EngineConfig
from s2a_bench.options import SEVERAL, Names, Options, Size, TextOrFile, group, option
from s2a_bench.plan import SKILL_SETS, SkillSet, load_skills
from s2a_bench.policy import COMPARED, POLICIES, PlanShape, Policy, Timing, policies
from s2a_bench.policy.conformal import GUARANTEE, Guarantee
from s2a_bench.policy.conformal import check as check_calibration
from s2a_bench.stats.seeds import Verbatim
from s2a_bench.transport import paths
from s2a_bench.transport.defaults import BLACK_BOX, FOLLOWED

if TYPE_CHECKING:
    from s2a_bench.harness.config import RequestsConfig

PROFILES: Final = ("rtx-4080", "jetson-agx-orin", "jetson-orin-nano")
REAL_TIME_PROFILE: Final = "jetson-agx-orin"
LENGTHS: Final = (6, 4, 2, 1)
LIVE_LENGTH: Final = 6
PLANS: Final = 1000
"""Default number of plans a cell if plans are random; else 1."""
MOST_SKILLS: Final = 2_000_000
"""Limit on the skills of a run: above it, studies are the tool."""
MOST_TOKENS: Final = 20_000_000
"""Limit on the tokens of a cell, which are in memory at once."""
MOST_CV: Final = 3**-0.5
"""Uniform durations of a larger spread could be negative."""
LEAST_T_NOM_S: Final = 1e-6
"""Run folders keep times in whole nanoseconds: a shorter skill would lose its digits."""

Counts = Annotated[tuple[Annotated[int, Field(ge=1)], ...], SEVERAL]
Rates = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...], SEVERAL]
Seconds = Annotated[tuple[Annotated[float, Field(ge=LEAST_T_NOM_S, allow_inf_nan=False)], ...], SEVERAL]


@dataclass(frozen=True, slots=True)
class PlanSetting:
    """The parameters of plans, without the policy."""

    board: str
    """A profile's name; empty for a bare rate."""
    title: str
    tokens_per_s: float
    prompt_s: float | None
    """c; None for a model."""
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    mode: str = "virtual"
    emulated: bool = True

    @property
    def name(self) -> str:
        board = self.board or f"{self.tokens_per_s:g}tps"
        return f"{board}/L{self.tokens_per_skill}/N{self.n_skills}/T{self.t_nom_s:g}"

    @property
    def key(self) -> Verbatim:
        """Return what its draws follow from: another field, or another name of one, is another draw."""
        values = ", ".join(f"{field.name}={getattr(self, field.name)!r}" for field in fields(self))
        return Verbatim(f"Setting({values})")  # a name in the seeds of all published runs

    def request_id(self, plan: int) -> str:
        return f"{self.name}/{plan}"


class ComparedOptions(Options):
    """Options for tokens of any source."""

    PANEL: ClassVar[str] = "Plans"

    policies: Names = option(
        COMPARED,
        f"{', '.join(POLICIES)}, with parameters as in NAME?parameter=value&other=value; several with commas",
        flag="policy",
        min_length=1,
        first=True,
        names=lambda: POLICIES,
    )
    profiles: Names = option(
        (),
        f"boards: names of 'profile list', or paths [default: {','.join(PROFILES)}; --real-time: {REAL_TIME_PROFILE}; "
        "none with --rate]; with --live what --engine replay plays",
        flag="profile",
        first=True,
        names=profile_files,
    )
    tokens_per_skill: Counts = option(
        (),
        "L, the delimiter included; several with commas "
        f"[default: {','.join(map(str, LENGTHS))}; --live: {LIVE_LENGTH}]",
        first=True,
    )
    n_skills: Counts = option((8,), "N, skills a plan; several with commas", min_length=1)
    t_nom_s: Seconds = option(
        (), "seconds a skill takes; several with commas [default: 1; --live: the skill set's own]", flag="t-nom"
    )
    t_min: float = option(0.8, "least duration of a skill, as a factor of T_nom", gt=0, le=1)
    t_max: float = option(1.5, "longest duration of a skill, as a factor of T_nom", ge=1, allow_inf_nan=False)
    seed: int = option(0, "seed of everything that is drawn", ge=0)
    epsilon: float = option(0.01, "share of plans that may stall: lambda is calibrated or tracked for it")
    track: bool = option(False, "let online policies follow lambda from plan to plan (needs jitter, or --live)")
    real_time: bool = option(False, "play the boards' tokens on the clock and execute while you watch", first=True)
    live: bool = option(False, "execute a model's real answers as they arrive", first=True)


class Modelled(Options):
    """Options for tokens without a model."""

    PANEL: ClassVar[str] = "Tokens that are modelled"

    rates: Rates = option((), "boards known by their tokens/s alone; several with commas", flag="rate", first=True)
    prompt_s: float | None = PROMPT_TIME
    t_nom_cv: float = option(0.0, "how much T_nom differs from skill to skill: sd / mean", ge=0, le=MOST_CV)
    plans: int | None = option(None, "plans a cell [default: 1; with jitter 1000]", ge=1)
    jitter: str = option(
        NO_JITTER,
        "none (even gaps, as in the paper), profile (its gaps), or a family of gaps, as lognormal:cv=0.2",
        first=True,
    )
    guarantee: Guarantee = GUARANTEE
    calibration_plans: int = option(400, "other plans that prior and lambda are learned from")
    calibrate: Path | None = option(
        None, "run folder of latency or throughput: learn prior and lambda from its answers instead"
    )


class LiveOptions(Options):
    """Options for tokens of a model."""

    PANEL: ClassVar[str] = "A model that answers"

    transport: str = option(
        "", "--live: ros, ros/action, http, http/VARIANT, shm, loopback [default: ros]", first=True, names=paths
    )
    skills: str = option("household", "--live: household, driving, or a TOML file", names=lambda: SKILL_SETS)
    requests: int = option(1, "--live: plans requested per cell", ge=1)
    task: TextOrFile = option("", "--live: the robot's task, text or @FILE")
    robot: str = option(
        "timed", "--live: timed, ros, call?function=MODULE:NAME; timed only waits", names=lambda: ROBOTS
    )
    engine: EngineConfig = group(
        EngineConfig,
        only=("name", "model", "mmproj", "chat_template", "threads", "gpu_layers", "pace"),
        about="--live: ",
        first=(),
    )
    source: str = option("synthetic", "--live: the camera", names=lambda: SOURCES)
    size: Size = option((640, 480), "--live: WIDTHxHEIGHT of the frames [default: 640x480]")
    url: str = option("", "--live: an HTTP server that runs already (a black box)")
    dialect: str = option("", "--live: the dialect of --url [default: detected]")
    nonce: str = option("", "--live: nonce of another run, to send its very pictures again [default: a new one]")
    no_grammar: bool = option(False, "--live: do not constrain the model's answer")
    warmup: int = option(1, "--live: first answers, from which policies learn the rate", ge=0)
    timeout_s: float = option(
        60.0, "--live: seconds without a token after which the robot holds", flag="timeout", ge=0.1, le=86_400
    )
    wait_for_server: float = option(0.0, "--live: seconds that the server of --url may take to start", ge=0, le=86_400)


class TimelineConfig(LiveOptions, Modelled, ComparedOptions):
    """The options of a run of plans: computed, played in real time, or live."""

    @property
    def virtual(self) -> bool:
        return not (self.live or self.real_time)

    @property
    def lengths(self) -> tuple[int, ...]:
        return self.tokens_per_skill or ((LIVE_LENGTH,) if self.live else LENGTHS)

    @cached_property
    def boards(self) -> list[Board]:
        found = [board_of_profile(load_profile(name), self.jitter, self.prompt_s) for name in self._profiles]
        return found + [board_of_rate(rate, self.jitter, self.prompt_s) for rate in self.rates]

    @cached_property
    def chosen(self) -> dict[str, Policy]:
        return policies(self.policies)

    @property
    def _profiles(self) -> tuple[str, ...]:
        default = () if self.rates else (REAL_TIME_PROFILE,) if self.real_time else PROFILES
        return self.profiles or default

    @cached_property
    def skill_set(self) -> SkillSet:
        return load_skills(self.skills)

    @property
    def random(self) -> bool:
        return self.t_nom_cv > 0 or not all(board.even for board in self.boards)

    @property
    def plans_a_cell(self) -> int:
        if self.live:
            return self.requests
        return self.plans if self.plans is not None else PLANS if self.random else 1

    def check(self) -> None:
        if self.track:
            check_tracking(self)
        if self.live:
            if self.real_time:
                raise UsageError("`live` and `real_time` are two things: a model answers, or a profile is played")
            if "epsilon" in self.given(ComparedOptions) and not self.track:
                raise UsageError("`epsilon`: nothing is calibrated with `live`; it needs `track`")
            if self.plans is not None:
                raise UsageError(f"`plans` are computed; with `live` write `requests` {self.plans}")
            for name in self.given(Modelled):
                raise UsageError(f"`{name}` is about tokens that are modelled; leave it out with `live`")
            check_live(self)
            return
        for name in self.given(LiveOptions):
            raise UsageError(f"`{name}` is about a model that answers; it needs `live`")
        self._check_modelled()

    def _check_modelled(self) -> None:
        _ = self.chosen
        check_calibration(self.calibration_plans, self.epsilon)
        if self.calibrate is not None and len(self.boards) != 1:
            raise UsageError("`calibrate`: the recorded machine is one board; name it with one `profiles` or `rates`")
        plans = self.plans_a_cell
        if plans > 1 and not self.random:
            raise UsageError("`plans`: without `jitter` or `t_nom_cv` all plans are the same; leave it out")
        skills = sum(setting.n_skills for _, setting in settings(self)) * len(self.chosen) * plans
        if skills > MOST_SKILLS:
            raise UsageError(f"`plans`: {skills} skills are more than the {MOST_SKILLS} of one run; ask for fewer")
        tokens = max(self.n_skills) * max(self.lengths)
        if (drawn := tokens * max(plans, self.calibration_plans)) > MOST_TOKENS:
            raise UsageError(
                f"`n_skills`, `tokens_per_skill`: {tokens} tokens a plan, {drawn} a cell: {MOST_TOKENS} is the most"
            )

    def shape(self, setting: PlanSetting) -> PlanShape:
        t_nom_s = setting.t_nom_s
        timing = Timing(t_nom_s, self.t_min * t_nom_s, self.t_max * t_nom_s)
        return PlanShape(setting.n_skills, setting.tokens_per_skill, timing, self.t_nom_cv)

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from requests_of(self).risks() if self.live else super().risks()
        if self.live and (risk := kind(self.robot, SkillKind).risk):
            yield "robot", risk, self.robot

    def to_manifest(self) -> dict[str, Any]:
        shared = self.model_dump(include=set(ComparedOptions.model_fields) - {"profiles", "real_time", "live"})
        shared |= {"tokens_per_skill": self.lengths, "plans": self.plans_a_cell}
        if self.live:
            plan = {"skills": self.skills, "task": self.task, "robot": self.robot, "constrained": not self.no_grammar}
            return {**requests_of(self).to_manifest(), **shared, **plan, "time": "live"}
        shared |= self.model_dump(include=set(Modelled.model_fields))
        shared |= {"profiles": self._profiles, "t_nom_s": self.t_nom_s or (1.0,)}
        return shared | ({"time": "real-time"} if self.real_time else {})


def check_tracking(config: TimelineConfig) -> None:
    """Refuse `track` if nothing varies or no lambda is free; raises UsageError."""
    if not any(policy.learns and policy.caution is None for policy in config.chosen.values()):
        raise UsageError("`track`: no policy has a lambda to follow; take stream-to-act without caution")
    if not config.live and not config.random:
        raise UsageError("`track`: without `jitter` or `t_nom_cv` all plans are the same; nothing can be learned")


def settings(config: TimelineConfig) -> Iterator[tuple[Board, PlanSetting]]:
    for n_skills, t_nom_s, board, tokens in product(
        config.n_skills, config.t_nom_s or (1.0,), config.boards, config.lengths
    ):
        yield board, PlanSetting(board.name, board.title, board.tokens_per_s, board.prompt_s, tokens, n_skills, t_nom_s)


def requests_of(config: TimelineConfig) -> RequestsConfig:
    """Return the configuration of the requests: one transport in one variant, without prompt and length."""
    from s2a_bench.harness.config import FirstVariants

    transport = config.transport or (BLACK_BOX if config.url else FOLLOWED)
    options: Any = {BLACK_BOX: {"url": config.url, "dialect": config.dialect}}
    return FirstVariants(
        transports=(transport,),
        options=options,
        source=config.source,
        size=config.size,
        engine=config.engine.but(profile=",".join(config.profiles)) if config.profiles else config.engine,
        requests=config.requests,
        warmup=config.warmup,
        seed=config.seed,
        nonce=config.nonce,
        timeout_s=config.timeout_s,
        wait_for_server=config.wait_for_server,
        sample_resources_hz=0,
    )


def check_live(config: TimelineConfig) -> None:
    """Raise UsageError, naming the fields, for options that model, robot or policy do not support."""
    requests = requests_of(config)
    if len(requests.pipelines) != 1:
        raise UsageError("`transport`: `live` follows one stream; name one, as ros, ros/action or http/binary")
    _ = config.skill_set
    for policy in config.chosen.values():
        policy.stepper(PlanShape(1, 1, Timing(1.0, 1.0, 1.0)))
    if not kind(config.robot, SkillKind).several and len(config.chosen) > 1:
        raise UsageError(f"`robot`: {config.robot} follows one policy at a time; choose it with `policies`")
    engine = config.engine
    if engine.pace and config.url:
        raise UsageError("`pace` needs the package's server, which holds its engine back; leave out `url`")
    if not engine.kind.computes:
        raise UsageError(f"`engine` {engine.name} writes no plans; `live` needs llama, or replay")
    if engine.kind.plays:
        if engine.pace:
            raise UsageError(f"`pace`: `engine` {engine.name} has its profile's rate; leave one of them out")
        skills, tokens = engine.kind.plays
        if (config.skills, config.lengths) != (skills, (tokens,)):
            raise UsageError(
                f"`engine` {engine.name} writes plans of the {skills} skills in {tokens} tokens a skill; "
                "leave out `skills` and `tokens_per_skill`"
            )
