"""The rows of a timeline run: plans under policies, and their skills."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import Final

from s2a_bench.experiments.timeline.metrics import METRICS
from s2a_bench.store.schema import Table, Value


@dataclass(frozen=True, slots=True)
class PlanRow:
    """What a row of `TIMELINES` says of its plan besides the metrics.

    ``board`` is a profile's name, empty where only a rate was given. ``mode`` says what passed the time: ``virtual``
    (computed), else a clock; ``emulated`` is true where no model answered. ``requested_ns`` is when the clock showed
    the request, from which all times count: 0 in virtual time.
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


TimelineRow: Final = make_dataclass(
    "TimelineRow",
    [
        (metric.column, metric.column_type, *([field(default=None)] if metric.optional else []))
        for metric in METRICS.values()
    ],
    bases=(PlanRow,),
    frozen=True,
    slots=True,
    kw_only=True,
)
"""One plan under one policy, with a column a metric. Motion is null for plans whose skills are not kept."""


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


TIMELINES: Final[Table[PlanRow]] = Table("timelines", TimelineRow)
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
