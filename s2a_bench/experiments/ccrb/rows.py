"""The rows of a CCRB run: roll-outs, and the trajectories of those that are shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class RolloutRow:
    """One roll-out of the driving scenario: what was tried, and what became of the cars. SI units.

    ``study`` is what it belongs to: point, phase or random; ``draw`` counts its scenarios. ``title`` names the board.
    ``late`` says that s2a-ttc could not keep the deadline ``deadline_ns`` (S_front) without stalls; null for others.
    Studies end when the outcome is decided, and have no least rear gap but that of an impact.
    Impact speeds are null without that impact, times to collision where the cars never closed in, the required
    deceleration (DRAC, to the lead) with a front impact, motion where no trajectory is kept, ``prompt_s`` where a model
    took what it took.
    """

    cell: str
    study: str
    draw: int
    policy: str
    board: str
    title: str
    emulated: bool
    simulator: str
    follower: str
    gap_behaviour: str
    reflex: bool
    lane_change: bool
    tokens_per_s: float
    prompt_s: float | None
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    speed_mps: float
    plan_decel_mps2: float
    front_gap_m: float
    lead_decel_mps2: float
    rear_gap_m: float
    reaction_s: float
    start_ns: int
    end_ns: int
    stalls: int
    stall_ns: int
    deadline_ns: int
    late: bool | None
    outcome: str
    impact_speed_mps: float | None
    front_impact_mps: float | None
    rear_impact_mps: float | None
    min_front_gap_m: float
    min_rear_gap_m: float | None
    min_front_ttc_s: float | None
    min_rear_ttc_s: float | None
    required_decel_mps2: float | None
    rms_jerk: float | None = None
    peak_jerk: float | None = None
    sparc: float | None = None


@dataclass(frozen=True, slots=True)
class TrajectoryRow:
    """The three cars of a shown roll-out at one time from the request; positions are bumper to bumper.

    ``phase`` says what the ego does: waiting, acting, gap or done; ``skill`` counts from 0, -1 before the first.
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
"""One row a roll-out of the driving scenario."""


TRAJECTORIES: Final[Table[TrajectoryRow]] = Table("trajectories", TrajectoryRow)
"""One row a moment of a shown roll-out."""
