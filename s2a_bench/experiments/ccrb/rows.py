"""The rows of a CCRB run, and the metrics of a policy at the operating point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final

from s2a_bench.experiments import COUNT, TIME, Better, Metric, columns
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.cars import FOLLOWERS, LEAST_IMPACT_MPS
from s2a_bench.store.schema import Many, NonNegative, Positive, Table, about, with_fields

_DEADLINE: Final = (
    "S_front: the latest start of the planned braking that keeps 2 m to the lead; negative: too late at the request."
)
_IMPACT: Final = (LEAST_IMPACT_MPS, None)
MPS2, MPS3 = "m/s\N{SUPERSCRIPT TWO}", "m/s\N{SUPERSCRIPT THREE}"


def _metric(name: str, unit: str, title: str = "", better: Better = "lower", **more: Any) -> Metric:
    """Return a metric of 0 or more; only times and counts (with a ``kind``) are never absent."""
    return Metric(name, unit, better, title, **{"bounds": (0, None), "optional": "kind" not in more, **more})


TIMES: Final = (
    _metric("start_s", "s", "start", kind=TIME),
    _metric("end_s", "s", kind=TIME),
    _metric("stalls", "", "stalls", kind=COUNT),
    _metric("stall_s", "s", "stalled", kind=TIME),
    _metric("deadline_s", "s", kind=TIME, bounds=(None, None), about=_DEADLINE),
)
IMPACTS: Final = (
    _metric("impact_speed_mps", "m/s", "impact", bounds=_IMPACT, about="Of the harder impact; absent without one."),
    _metric("front_impact_mps", "m/s", bounds=_IMPACT),
    _metric("rear_impact_mps", "m/s", bounds=_IMPACT),
    _metric("min_front_gap_m", "m", "front gap", "higher", optional=False),
    _metric("min_rear_gap_m", "m", "rear gap", "higher"),
)
MARGINS: Final = (
    _metric("min_front_ttc_s", "s", "TTC front", "higher", about="Absent where the cars never closed in."),
    _metric("min_rear_ttc_s", "s", "TTC rear", "higher"),
    _metric(
        *("required_decel_mps2", MPS2, "DRAC"),
        about="Greatest closing speed^2 / (2 gap) towards the lead; absent with a front impact.",
    ),
)
MOTION: Final = (
    _metric("rms_jerk", MPS3, "RMS jerk"),
    _metric("peak_jerk", MPS3, "peak jerk"),
    _metric("sparc", "", "SPARC", "higher", bounds=(None, 0)),
)
LOOP: Final = (
    _metric("real_time_factor", "", "real-time factor", "higher", about="Simulated over elapsed time: 1 is in time."),
    _metric("tracking_rms_mps", "m/s", "tracking", about="RMS of set-point minus speed in skills, if one ran."),
)
"""Metrics of closed loops alone."""
METRICS: Final = (*TIMES, *IMPACTS, *MARGINS, *MOTION, *LOOP)


@dataclass(frozen=True, slots=True)
class AboutRollout:
    """The columns of a row of `ROLLOUTS` besides the metrics: what was tried. SI units.

    ``study`` is point, rollout (beside a closed loop, on the arrivals of its plan), phase or random; ``draw`` counts
    its scenarios. ``title`` names the board. ``late``: s2a-ttc could not keep the deadline ``deadline_ns`` (S_front)
    without stalls; null for other policies. Studies stop when the outcome is decided: their least rear gap is null
    without an impact. Null are also impact speeds without that impact, times to collision where the cars never closed
    in, the required deceleration (DRAC, to the lead) with a front impact, motion without a trajectory, and ``prompt_s``
    of a live model.
    """

    cell: Annotated[str, {"minLength": 1}]
    study: str
    draw: int
    policy: Annotated[str, {"minLength": 1}]
    board: str
    title: str
    emulated: Annotated[bool, about("True where no model answered.")]
    simulator: Annotated[str, {"minLength": 1}]
    follower: Annotated[str, {"enum": list(FOLLOWERS)}]
    gap_behaviour: Annotated[str, {"enum": list(GAPS)}]
    reflex: bool
    lane_change: bool
    tokens_per_s: float
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


RolloutRow: Final = with_fields(
    "RolloutRow",
    "One roll-out of the driving scenario: what was tried, and what became of the cars.",
    AboutRollout,
    {
        **columns(TIMES),
        "late": Annotated[bool | None, about("s2a-ttc only: no stall-free start keeps the deadline.")],
        "outcome": Annotated[str, {"enum": ["none", "front", "rear", "both"]}],
        **columns((*IMPACTS, *MARGINS, *MOTION, *LOOP)),
    },
)


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


ROLLOUTS: Final[Table[AboutRollout]] = Table("rollouts", RolloutRow)
TRAJECTORIES: Final[Table[TrajectoryRow]] = Table("trajectories", TrajectoryRow)
