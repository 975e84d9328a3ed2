"""The options of timelines: policies on plans, computed on boards' tokens, played in real time, or of a model."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from pydantic import Field

from s2a_bench.act import ROBOTS, SkillKind, kind
from s2a_bench.boards.profile import load_profile, profile_files
from s2a_bench.boards.tokens import NO_JITTER, PROMPT_TIME, Board, board_of_profile, board_of_rate
from s2a_bench.errors import UsageError
from s2a_bench.harness.config import GROUPED
from s2a_bench.harness.timelines.cases import MOST_CV, PlanCase
from s2a_bench.harness.timelines.config import PlanRequests, PolicyOptions, check_steppers
from s2a_bench.options import SEVERAL, Names, TextOrFile, group, option
from s2a_bench.plan import SKILL_SETS, SkillSet, load_skills
from s2a_bench.policy import PlanShape, Timing
from s2a_bench.policy.conformal import GUARANTEE, Guarantee
from s2a_bench.policy.conformal import check as check_calibration

PROFILES: Final = ("rtx-4080", "jetson-agx-orin", "jetson-orin-nano")
PLANS: Final = 1000
"""Default number of plans a cell if plans are random; else 1."""
MOST_SKILLS: Final = 2_000_000
"""Limit on the skills of a run: above it, studies are the tool."""
MOST_TOKENS: Final = 20_000_000
"""Limit on the tokens of a cell, which are in memory at once."""
LEAST_T_NOM_S: Final = 1e-6
"""Run folders keep times in whole nanoseconds: a shorter skill would lose its digits."""

Counts = Annotated[tuple[Annotated[int, Field(ge=1)], ...], SEVERAL]
Rates = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...], SEVERAL]
Seconds = Annotated[tuple[Annotated[float, Field(ge=LEAST_T_NOM_S, allow_inf_nan=False)], ...], SEVERAL]
ABOUT_L: Final = "L, the delimiter included; several with commas"
ABOUT_T_NOM: Final = "seconds a skill takes; several with commas"
ABOUT_PROFILES: Final = (
    "boards: names of 'profile list', or paths; none by default with --rate; with --live what --engine replay plays"
)


class TimelineOptions(PolicyOptions):
    """Options for tokens of any source."""

    PANEL: ClassVar[str] = "Plans"

    tokens_per_skill: Counts = option((6, 4, 2, 1), ABOUT_L, min_length=1, first=True)
    n_skills: Counts = option((8,), "N, skills a plan; several with commas", min_length=1)
    t_nom_s: Seconds = option((1.0,), ABOUT_T_NOM, flag="t-nom", min_length=1)
    t_min: float = option(0.8, "least duration of a skill, as a factor of T_nom", gt=0, le=1)
    t_max: float = option(1.5, "longest duration of a skill, as a factor of T_nom", ge=1, allow_inf_nan=False)
    epsilon: float = option(0.01, "share of plans that may stall: lambda is calibrated or tracked for it")
    track: bool = option(False, "let online policies follow lambda from plan to plan (modelled tokens need jitter)")

    def lasting(self, t_nom_s: float) -> Timing:
        return Timing(t_nom_s, self.t_min * t_nom_s, self.t_max * t_nom_s)

    def check(self) -> None:
        if self.track and not any(each.learns and each.caution is None for each in self.named_policies.values()):
            raise UsageError("`track`: no policy has a lambda to follow; take stream-to-act without caution")


class TimelineComputed(TimelineOptions):
    """Options for modelled tokens, computed in virtual time."""

    PANEL: ClassVar[str] = "Tokens that are modelled"
    MODE: ClassVar[str] = "virtual"
    virtual: ClassVar[bool] = True

    profiles: Names = option(PROFILES, ABOUT_PROFILES, flag="profile", panel="Plans", first=True, names=profile_files)
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

    @property
    def board_names(self) -> tuple[str, ...]:
        return () if self.rates and "profiles" not in self.model_fields_set else self.profiles

    @cached_property
    def boards(self) -> list[Board]:
        boards = [board_of_profile(load_profile(name), self.jitter, self.prompt_s) for name in self.board_names]
        return boards + [board_of_rate(rate, self.jitter, self.prompt_s) for rate in self.rates]

    @cached_property
    def cases(self) -> tuple[PlanCase, ...]:
        every = product(self.n_skills, map(self.lasting, self.t_nom_s), self.boards, self.tokens_per_skill)
        return tuple(
            PlanCase.of(board, PlanShape(n_skills, tokens, durations, self.t_nom_cv), self.MODE)
            for n_skills, durations, board, tokens in every
        )

    @property
    def random(self) -> bool:
        return self.t_nom_cv > 0 or not all(board.even for board in self.boards)

    @property
    def plans_a_cell(self) -> int:
        if self.plans is not None:
            return self.plans
        return PLANS if self.random else 1

    def check(self) -> None:
        super().check()
        check_calibration(self.calibration_plans, self.epsilon)
        if not self.boards:
            raise UsageError("`profiles`: name at least one, or one of `rates`")
        if self.calibrate is not None and len(self.boards) != 1:
            raise UsageError("`calibrate`: the recorded machine is one board; name it with one `profiles` or `rates`")
        plans = self.plans_a_cell
        for name, value in (("track", self.track), ("plans", plans > 1)):
            if value and not self.random:
                raise UsageError(f"`{name}`: without `jitter` or `t_nom_cv` all plans are the same; leave it out")
        skills = sum(case.shape.n_skills for case in self.cases) * len(self.named_policies) * plans
        if skills > MOST_SKILLS:
            raise UsageError(f"`plans`: {skills} skills are more than the {MOST_SKILLS} of one run; ask for fewer")
        tokens = max(case.tokens for case in self.cases)
        if (total := tokens * max(plans, self.calibration_plans)) > MOST_TOKENS:
            raise UsageError(
                f"`n_skills`, `tokens_per_skill`: {tokens} tokens a plan, {total} a cell: {MOST_TOKENS} is the most"
            )

    def to_manifest(self) -> dict[str, Any]:
        return {**self.model_dump(), "profiles": self.board_names}


class TimelineRealTime(TimelineComputed):
    """Options for modelled tokens that are played on the clock."""

    MODE: ClassVar[str] = "real-time"
    virtual: ClassVar[bool] = False

    profiles: Names = option(("jetson-agx-orin",), ABOUT_PROFILES, flag="profile", names=profile_files)

    def to_manifest(self) -> dict[str, Any]:
        return {**super().to_manifest(), "time": self.MODE}


class TimelineLive(TimelineOptions):
    """Options for the plans of a model."""

    PANEL: ClassVar[str] = "A model that answers"

    tokens_per_skill: Counts = option((6,), ABOUT_L, min_length=1)
    t_nom_s: Seconds = option((), f"{ABOUT_T_NOM} [default: the skill set's own]", flag="t-nom")
    skills: str = option("household", "household, driving, or a TOML file", names=lambda: SKILL_SETS)
    task: TextOrFile = option("", "the robot's task, text or @FILE")
    robot: str = option("timed", "timed, ros, call?function=MODULE:NAME; timed only waits", names=lambda: ROBOTS)
    no_grammar: bool = option(False, "do not constrain the model's answer")
    requests: PlanRequests = group(PlanRequests, only=(*GROUPED, "requests"), first=("transports",))

    @cached_property
    def skill_set(self) -> SkillSet:
        return load_skills(self.skills)

    def check(self) -> None:
        super().check()
        if "epsilon" in self.model_fields_set and not self.track:
            raise UsageError("`epsilon`: no policy is calibrated before a live run; it needs `track`")
        _ = self.skill_set
        check_steppers(self.named_policies.values())
        if not kind(self.robot, SkillKind).several and len(self.named_policies) > 1:
            raise UsageError(f"`robot`: {self.robot} follows one policy at a time; choose it with `policies`")
        self.requests.require_played(self.skills, self.tokens_per_skill, "`skills` and `tokens_per_skill`")

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        if risk := kind(self.robot, SkillKind).risk:
            yield "robot", risk, self.robot

    def to_manifest(self) -> dict[str, Any]:
        """Return the entries besides those of the requests."""
        fields = self.model_dump(exclude={"requests", "no_grammar"})
        return {**fields, "plans": self.requests.requests, "constrained": not self.no_grammar, "time": "live"}
