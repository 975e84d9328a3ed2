"""What a CCRB run compares: policies, a board, the scenario's numbers, a simulator; and what it refuses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from s2a_bench.errors import UsageError
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.harness.ranges import require
from s2a_bench.plan import load_skills
from s2a_bench.plan.skillset import GAPS, Durations, Gap
from s2a_bench.scenario import SIMULATORS
from s2a_bench.scenario.ccrb.cars import EGO_LEAST_MPS2, KMH, Cars, braking_plan
from s2a_bench.scenario.ccrb.follower import FOLLOWERS

SKILL_SET: Final = "driving"
LONG_S: Final = 600.0
"""Plans that take longer than this are no driving."""
MOST_RANDOM: Final = 100_000


@dataclass(frozen=True)
class CcrbConfig:
    """The defaults are the operating point at which the paper's outcome comes about."""

    policies: tuple[str, ...] = ("naive", "wait-then-act", "stream-to-act")
    profile: str = "jetson-agx-orin"
    """A board; unused with a rate."""
    rate: float | None = None
    prompt_s: float | None = None
    """c; None: the profile's, and 0 for a rate."""
    tokens_per_skill: int = 6
    n_skills: int = 5
    """Speed set-points; a lane change comes on top."""
    t_nom_s: float | None = None
    """None: as the driving skill set has it."""
    speed_kmh: float = 50.0
    plan_decel_mps2: float | None = None
    """a_p; None: down to rest, or to half the speed before a lane change."""
    front_gap_m: float = 40.0
    lead_decel_mps2: float = 2.0
    rear_gap_m: float = 14.0
    reaction_s: float = 1.3
    gap: str = "stop"
    follower: str = "careful"
    simulator: str = "longitudinal"
    reflex: bool = False
    ttc: bool = False
    """Whether stream-to-act with the deadline of the car ahead is added."""
    lane_change: bool = False
    phase: bool = False
    phase_rates: tuple[float, ...] = (2.0, 12.0)
    phase_gaps_m: tuple[float, ...] = (6.0, 30.0)
    phase_points: tuple[int, int] = (41, 25)
    random: int = 0
    """Random scenarios; 0: none."""
    seed: int = 0

    @cached_property
    def durations(self) -> Durations:
        """Return how long a set-point takes: the skill set's, scaled to T_nom where that is given."""
        durations = next(skill.durations for skill in load_skills(SKILL_SET).skills if skill.name == "set_speed")
        factor = 1.0 if self.t_nom_s is None else self.t_nom_s / durations.nominal_s
        return Durations(durations.least_s * factor, durations.nominal_s * factor, durations.most_s * factor)

    @cached_property
    def lane_durations(self) -> Durations:
        """Return how long a lane change takes."""
        return next(skill.durations for skill in load_skills(SKILL_SET).skills if skill.name == "change_lane")

    @cached_property
    def timeline(self) -> TimelineConfig:
        """Return the timeline run whose plans these are: one setting, even tokens."""
        nominal_s = self.durations.nominal_s
        return TimelineConfig(
            policies=self.policies,
            profiles=() if self.rate is not None else (self.profile,),
            rates=(self.rate,) if self.rate is not None else (),
            prompt_s=self.prompt_s,
            tokens_per_skill=(self.tokens_per_skill,),
            n_skills=(self.n_skills + self.lane_change,),
            t_nom_s=(nominal_s,),
            t_min=self.durations.least_s / nominal_s,
            t_max=self.durations.most_s / nominal_s,
            seed=self.seed,
        )

    @property
    def cars(self) -> Cars:
        """Return the scenario of the operating point."""
        return Cars(
            front_gap_m=self.front_gap_m,
            lead_decel_mps2=self.lead_decel_mps2,
            rear_gap_m=self.rear_gap_m,
            reaction_s=self.reaction_s,
            speed_mps=self.speed_kmh * KMH,
            gap=self.gap_behaviour,
            follower=self.follower,
            reflex=self.reflex,
        )

    @property
    def gap_behaviour(self) -> Gap:
        """Return what the ego does between skills; raises UsageError for what it cannot do."""
        for gap in GAPS:
            if gap == self.gap:
                return gap
        raise UsageError(f"--gap-behaviour: '{self.gap}' is none of {', '.join(GAPS)}")

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError naming the flag."""
        _known("--simulator", self.simulator, SIMULATORS)
        _known("--follower", self.follower, FOLLOWERS)
        require("--skills", [self.n_skills], 1, 100)
        require("--tokens-per-skill", [self.tokens_per_skill], 1, 1000)
        require("--t-nom", [self.durations.nominal_s], 0, 60, above=True)
        require("--speed", [self.speed_kmh], 0, 200, above=True)
        require("--front-gap", [self.front_gap_m], 0, 1000, above=True)
        require("--rear-gap", [self.rear_gap_m], 0, 1000, above=True)
        require("--lead-decel", [self.lead_decel_mps2], 0, 10, above=True)
        require("--reaction", [self.reaction_s], 0, 10)
        require("--random", [self.random], 0, MOST_RANDOM)
        require("--phase-rates", self.phase_rates, 0, above=True)
        require("--phase-gaps", self.phase_gaps_m, 0, 1000, above=True)
        for flag, values in (("--phase-rates", self.phase_rates), ("--phase-gaps", self.phase_gaps_m)):
            if len(values) != 2 or not values[0] < values[1]:  # noqa: PLR2004 - from, to
                raise UsageError(f"{flag}: should be two numbers, the lower first")
        if self.plan_decel_mps2 is not None:
            require("--plan-decel", [self.plan_decel_mps2], 0, -EGO_LEAST_MPS2, above=True)
        if self.rate is not None:
            require("--rate", [self.rate], 0, above=True)
        if self.lane_change and self.simulator == "longitudinal":
            raise UsageError("--lane-change: the longitudinal simulator knows one lane; take --simulator embedded")
        _ = self.gap_behaviour
        self.timeline.check()
        self._check_length()
        first = braking_plan(
            self.cars, self.n_skills, self.durations.nominal_s, decel_mps2=self.plan_decel_mps2
        ).set_point_mps
        if (steepest := float(first[0, 0] - first[1, 0]) / self.durations.nominal_s) > -EGO_LEAST_MPS2:
            raise UsageError(
                f"--skills x --t-nom: the plan brakes at {steepest:.3g} m/s^2, which is more than the ego can; "
                "allow more time, or give --plan-decel"
            )

    def _check_length(self) -> None:
        """Refuse plans that no drive could wait for."""
        board = self.timeline.boards[0]
        whole_s = board.prompt_s + self.tokens_per_skill * (self.n_skills + 1) / board.tokens_per_s
        if whole_s > LONG_S:
            raise UsageError(
                f"--rate, --pace or --profile: the whole plan takes {whole_s:.0f} s to arrive, "
                f"which is no driving; at most {LONG_S:.0f} s"
            )


def _known(flag: str, name: str, names: Iterable[str]) -> None:
    """Refuse a name that a table does not have."""
    if name not in (known := list(names)):
        raise UsageError(f"{flag}: '{name}' is none of {', '.join(known)}")
