"""Options of the scenario: the cars' numbers and the plan's set-points."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import Annotated, ClassVar, Final

from s2a_bench.errors import UsageError
from s2a_bench.options import Options, one_of, option
from s2a_bench.plan import Call, Skill, load_skills
from s2a_bench.plan.skillset import GAPS, Gap
from s2a_bench.scenario.ccrb.cars import (
    EGO_LEAST_MPS2,
    FOLLOWERS,
    KMH,
    Cars,
    DrivingPlan,
    braking_plan,
    plan_decel,
    start_deadline,
)
from s2a_bench.scenario.ccrb.labels import law
from s2a_bench.types import Timing

SKILL_SET: Final = "driving"


class CcrbOptions(Options):
    """One scenario; the defaults are the operating point with the paper's outcome."""

    PANEL: ClassVar[str] = "Scenario"

    n_skills: int = option(5, "N, speed set-points down to rest", flag="skills", ge=1, le=100)
    t_nom_s: float | None = option(
        None, "seconds a set-point takes [default: the skill set's 0.8]", flag="t-nom", ge=1e-6, le=60
    )
    speed_kmh: float = option(50.0, "of all three cars in the beginning, km/h", flag="speed", gt=0, le=200)
    plan_decel_mps2: float | None = option(
        None,
        "m/s^2 that the plan brakes with [default: as needed to come to rest]",
        flag="plan-decel",
        gt=0,
        le=-EGO_LEAST_MPS2,
    )
    front_gap_m: float = option(40.0, "m to the lead; Euro NCAP: 12 or 40", flag="front-gap", gt=0, le=1000, first=True)
    lead_decel_mps2: float = option(2.0, "m/s^2 of the lead; Euro NCAP: 2 or 6", flag="lead-decel", gt=0, le=10)
    rear_gap_m: float = option(14.0, "m to the car behind", flag="rear-gap", gt=0, le=1000, first=True)
    reaction_s: float = option(1.3, "seconds until the car behind reacts", flag="reaction", ge=0, le=10)
    gap: Gap = option("stop", f"what the ego does while no skill is valid: {', '.join(GAPS)}", flag="gap-behaviour")
    follower: Annotated[str, one_of(lambda: FOLLOWERS)] = option(
        "careful", f"the law of the car behind: {', '.join(FOLLOWERS)}"
    )
    reflex: bool = option(False, "let the ego brake by itself below the plan")
    lane_change: bool = option(False, "end the plan with a lane change; not along the lane")

    @cached_property
    def durations(self) -> Timing:
        """Return the durations of a set-point: the skill set's, scaled to T_nom if given."""
        durations = _skill("set_speed").durations
        factor = 1.0 if self.t_nom_s is None else self.t_nom_s / durations.nominal_s
        return Timing(durations.nominal_s * factor, durations.least_s * factor, durations.most_s * factor)

    @cached_property
    def lane_durations(self) -> Timing:
        return _skill("change_lane").durations

    @property
    def skills(self) -> int:
        return self.n_skills + self.lane_change

    @property
    def cars(self) -> Cars:
        """Return the cars, whose fields but the speed are options."""
        return Cars(speed_mps=self.speed_kmh * KMH, **self.model_dump(include={each.name for each in fields(Cars)}))

    @property
    def follower_law(self) -> str:
        return law(self.model_dump())

    @cached_property
    def follower_survives(self) -> bool:
        from s2a_bench.scenario.ccrb.drive import follower_survives

        return bool(follower_survives(self.cars, self.driving, self.skills, self.durations.nominal_s)[0])

    @property
    def decel_mps2(self) -> float:
        if self.plan_decel_mps2 is not None:
            return self.plan_decel_mps2
        return float(plan_decel(self.cars, self.n_skills, self.durations.nominal_s, lane_change=self.lane_change))

    @property
    def driving(self) -> DrivingPlan:
        nominal_s = self.durations.nominal_s
        return braking_plan(
            self.cars, self.n_skills, nominal_s, decel_mps2=self.decel_mps2, lane_change=self.lane_change
        )

    @property
    def deadline_s(self) -> float:
        return float(start_deadline(self.cars, self.decel_mps2))

    @property
    def calls(self) -> list[Call]:
        """Return the plan's skills, with the scenario's durations and gap behaviour."""
        speed = replace(_skill("set_speed"), durations=self.durations, gap=self.gap)
        lane = replace(_skill("change_lane"), durations=self.lane_durations, gap=self.gap)
        plan = self.driving
        kmh = (plan.set_point_mps[1:, 0] / KMH).round(1)
        return [
            Call(lane, ("left",)) if aside else Call(speed, (f"{point:g}",))
            for point, aside in zip(kmh, plan.lane, strict=True)
        ]

    def check(self) -> None:
        first = self.driving.set_point_mps
        if (steepest := float(first[0, 0] - first[1, 0]) / self.durations.nominal_s) > -EGO_LEAST_MPS2:
            raise UsageError(
                f"`n_skills` x `t_nom_s`: the plan brakes at {steepest:.3g} m/s^2, which is more than the ego can; "
                "allow more time, or give `plan_decel_mps2`"
            )


def _skill(name: str) -> Skill:
    return next(skill for skill in load_skills(SKILL_SET).skills if skill.name == name)
