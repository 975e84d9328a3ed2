"""The rows of a CCRB run, and the metrics of a policy at the operating point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from s2a_bench.bounds import Facts, Many, NonNegative, Positive, about
from s2a_bench.experiments.cells import ANY, HIDDEN, JsonKey, Metric, metrics_of
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.cars import FOLLOWERS, LEAST_IMPACT_MPS
from s2a_bench.scenario.ccrb.labels import outcome_label
from s2a_bench.store.schema import Table

_DEADLINE: Final = (
    "S_front: the latest start of the planned braking that keeps 2 m to the lead; negative: too late at the request."
)
_IMPACT: Final = (LEAST_IMPACT_MPS, None)
MPS2, MPS3 = "m/s\N{SUPERSCRIPT TWO}", "m/s\N{SUPERSCRIPT THREE}"


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutRow:
    """One roll-out of the driving scenario: what was tried, and what became of the cars. SI units.

    ``study`` is point, rollout (beside a closed loop, on the arrivals of its plan), phase or random; ``draw`` counts
    its scenarios. ``title`` names the board. ``late``: s2a-ttc could not keep the deadline ``deadline_ns`` (S_front)
    without stalls; null for other policies. Studies stop when the outcome is decided: their least rear gap is null
    without an impact. Null are also impact speeds without that impact, times to collision where the cars never closed
    in, the required deceleration (DRAC, to the lead) with a front impact, motion without a trajectory, and ``prompt_s``
    of a live model.
    """

    cell: Annotated[str, Facts(minLength=1)]
    study: str
    draw: Annotated[int, HIDDEN]
    policy: Annotated[str, Facts(minLength=1)]
    board: Annotated[str, JsonKey("profile")]
    title: Annotated[str, HIDDEN]
    emulated: Annotated[bool, about("True where no model answered.")]
    simulator: Annotated[str, Facts(minLength=1)]
    follower: Annotated[str, Facts(enum=list(FOLLOWERS))]
    gap_behaviour: Annotated[str, Facts(enum=list(GAPS))]
    reflex: bool
    lane_change: bool
    tokens_per_s: Annotated[Positive, JsonKey("rate_tokens_per_s")]
    prompt_s: Annotated[NonNegative | None, about("c; absent with --live.")]
    tokens_per_skill: Many
    n_skills: Annotated[Many, about("A lane change included.")]
    t_nom_s: NonNegative
    speed_mps: Annotated[Positive, about("v0.")]
    plan_decel_mps2: NonNegative
    front_gap_m: NonNegative
    lead_decel_mps2: NonNegative
    rear_gap_m: NonNegative
    reaction_s: NonNegative
    follower_survives: Annotated[
        bool | None,
        about("Whether the car behind avoids an ego with immediate tokens; if not, a rear impact proves nothing."),
    ]
    start_ns: Annotated[int, Metric("start")]
    end_ns: Annotated[int, Metric()]
    stalls: Annotated[int, Metric("stalls")]
    stall_ns: Annotated[int, Metric("stalled")]
    deadline_ns: Annotated[int, Metric(about=_DEADLINE, bounds=ANY)]
    late: Annotated[bool | None, about("s2a-ttc only: no stall-free start keeps the deadline.")] = None
    outcome: Literal["none", "front", "rear", "both"]
    impact_speed_mps: Annotated[
        float | None, Metric("impact", "Of the harder impact; absent without one.", unit="m/s", bounds=_IMPACT)
    ] = None
    front_impact_mps: Annotated[float | None, Metric(unit="m/s", bounds=_IMPACT)] = None
    rear_impact_mps: Annotated[float | None, Metric(unit="m/s", bounds=_IMPACT)] = None
    min_front_gap_m: Annotated[float, Metric("front gap", unit="m", better="higher")]
    min_rear_gap_m: Annotated[float | None, Metric("rear gap", unit="m", better="higher")] = None
    min_front_ttc_s: Annotated[
        float | None, Metric("TTC front", "Absent where the cars never closed in.", unit="s", better="higher")
    ] = None
    min_rear_ttc_s: Annotated[float | None, Metric("TTC rear", unit="s", better="higher")] = None
    required_decel_mps2: Annotated[
        float | None,
        Metric("DRAC", "Greatest closing speed^2 / (2 gap) towards the lead; absent with a front impact.", unit=MPS2),
    ] = None
    rms_jerk: Annotated[float | None, Metric("RMS jerk", unit=MPS3)] = None
    peak_jerk: Annotated[float | None, Metric("peak jerk", unit=MPS3)] = None
    sparc: Annotated[float | None, Metric("SPARC", better="higher", bounds=(None, 0))] = None
    real_time_factor: Annotated[
        float | None, Metric("real-time factor", "Simulated over elapsed time: 1 is in time.", better="higher")
    ] = None
    tracking_rms_mps: Annotated[
        float | None, Metric("tracking", "RMS of set-point minus speed in skills, if one ran.", unit="m/s")
    ] = None

    @property
    def label(self) -> str:
        """The outcome in words."""
        return outcome_label(self.outcome, bool(self.follower_survives)) + (" (late)" if self.late else "")


METRICS: Final = metrics_of(RolloutRow)


@dataclass(frozen=True, slots=True)
class TrajectoryRow:
    """The three cars of a recorded roll-out at one time from the request; positions are bumper to bumper.

    ``phase`` of the ego: waiting, acting, gap or done; ``skill`` counts from 0, -1 before the first.
    """

    cell: str
    at_ns: int
    phase: str
    skill: int
    lead_position_m: float
    ego_position_m: float
    rear_position_m: float
    ego_lateral_m: float
    lead_speed_mps: float
    ego_speed_mps: float
    rear_speed_mps: float
    lead_acceleration_mps2: float
    ego_acceleration_mps2: float
    rear_acceleration_mps2: float


ROLLOUTS: Final[Table[RolloutRow]] = Table("rollouts", RolloutRow)
TRAJECTORIES: Final[Table[TrajectoryRow]] = Table("trajectories", TrajectoryRow)
