"""The rows of a timeline run: plans under policies, and their skills."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.store.schema import Table, Value


@dataclass(frozen=True, slots=True)
class TimelineRow:
    """One plan under one policy, with its metrics as `policy.metrics` defines them; times count from the request.

    ``board`` is a profile's name, empty where only a rate was given. ``mode`` says what passed the time: ``virtual``
    (computed), else a clock; ``emulated`` is true where no model answered. ``requested_ns`` is when the clock showed
    the request: 0 in virtual time. ``safe_start_ns`` is S0, ``last_arrival_ns`` t_N, ``safe_end_ns`` S0 + P_N,
    ``least_end_ns`` E_lo. ``any_stall`` counts stalls too short for ``stalls``. Motion is null for plans whose skills
    are not kept.
    """

    cell: str
    policy: str
    board: str
    title: str
    mode: str
    emulated: bool
    tokens_per_s: float
    prompt_s: float | None
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    plan: int
    request_id: str
    requested_ns: int
    caution: float | None
    start_ns: int
    end_ns: int
    safe_start_ns: int
    last_arrival_ns: int
    safe_end_ns: int
    least_end_ns: int
    stalls: int
    any_stall: bool
    stall_ns: int
    longest_stall_ns: int
    stall_ratio: float
    start_regret: float
    signed_start_regret: float
    start_regret_of_wait: float
    end_regret: float
    end_regret_of_wait: float
    end_regret_elastic: float
    mean_queue_wait_ns: int
    longest_queue_wait_ns: int
    mean_action_age_ns: int
    oldest_action_ns: int
    speed_distortion: float
    fluidity: float
    rms_jerk: float | None = None
    peak_jerk: float | None = None
    sparc: float | None = None


@dataclass(frozen=True, slots=True)
class SkillRow:
    """One skill of a plan: when its fragment was complete, when it ran; ``stall_ns`` is the stall before it.

    Times count from the request. ``text`` is the call, empty where no model wrote one. ``due_ns``, of skills that were
    really executed, is when the reason to start was there; it is null where times were computed.
    """

    cell: str
    request_id: str
    plan: int
    index: int
    text: str
    arrival_ns: int
    start_ns: int
    end_ns: int
    stall_ns: int
    nominal_ns: int
    least_ns: int
    most_ns: int
    due_ns: int | None = None


TIMELINES: Final[Table[TimelineRow]] = Table("timelines", TimelineRow)
"""One row a plan and policy."""


def _derive_skill(row: SkillRow) -> dict[str, Value]:
    """Compute how long a skill lay ready, its duration over the nominal one, and how late the robot had the order."""
    stretch = (row.end_ns - row.start_ns) / row.nominal_ns if row.nominal_ns else None
    jitter_ns = None if row.due_ns is None else row.start_ns - row.due_ns
    return {"queue_wait_ns": row.start_ns - row.arrival_ns, "stretch": stretch, "start_jitter_ns": jitter_ns}


SKILLS: Final[Table[SkillRow]] = Table(
    "skills",
    SkillRow,
    {"queue_wait_ns": "int64", "stretch": "float64", "start_jitter_ns": "int64"},
    _derive_skill,
)
"""One row a skill."""
