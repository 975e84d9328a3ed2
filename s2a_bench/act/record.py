"""What an executor did: skills as they really ran, the orders it gave, and how the plan ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from s2a_bench.act.events import Fault
from s2a_bench.plan import Call
from s2a_bench.policy import Plans, PlanShape

Outcome: TypeAlias = Literal["completed", "short", "skill-failed", "skill-overran", "aborted"] | Fault
"""How a plan ended. ``short``: the stream ended properly, with fewer skills than announced; they were carried out."""

What: TypeAlias = Literal["start", "extend", "compress", "end", "hold", "abort"]


@dataclass(slots=True)
class SkillRun:
    """One skill that was started; times on the executor's clock, in ns."""

    index: int
    call: Call
    arrival_ns: int
    due_ns: int
    """When the reason to start it was there: a time the policy named, an arrival, or the end of the skill before."""
    ordered_ns: int
    """When the order was given: what the durations count from."""
    start_ns: int
    """When the robot had the order."""
    duration_ns: int
    """As first ordered by the policy."""
    latest_ns: int
    """How long it may be held on for while the next skill is missing."""
    until_ns: int
    """The end as ordered last."""
    end_ns: int | None = None
    """When it was over; None while it runs."""

    @property
    def jitter_ns(self) -> int:
        """Return the start jitter: from the reason to start until the robot had the order."""
        return self.start_ns - self.due_ns


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """An order to the robot; ``index`` is the skill's, -1 for a hold before the first."""

    at_ns: int
    what: What
    index: int


@dataclass(slots=True)
class Record:
    """All of one plan under one policy; filled while it runs, so that it can be watched."""

    policy: str
    requested_ns: int | None = None
    token_ns: list[int] = field(default_factory=list)
    arrivals: list[tuple[int, Call]] = field(default_factory=list)
    ended_ns: int | None = None
    """When the stream ended or broke."""
    skills: list[SkillRun] = field(default_factory=list)
    commands: list[RobotCommand] = field(default_factory=list)
    extra: int = 0
    """Skills beyond those announced, which were not carried out."""
    outcome: Outcome | None = None
    """None while it runs."""
    why: str = ""
    """What went wrong, where something did."""

    @property
    def ran(self) -> list[SkillRun]:
        return [skill for skill in self.skills if skill.end_ns is not None]

    @property
    def stalls_ns(self) -> list[int]:
        """Return how long the robot had nothing to do between skills, as it happened."""
        return [after.start_ns - (before.end_ns or 0) for before, after in zip(self.ran, self.skills[1:], strict=False)]


def observed(record: Record, shape: PlanShape) -> Plans | None:
    """Return the plan as it came, one column with tokens and ``shape``; None where it did not come whole."""
    import numpy as np

    zero_ns, arrivals = record.requested_ns, record.arrivals[: shape.n_skills]
    if zero_ns is None or len(arrivals) < shape.n_skills or not record.token_ns:
        return None

    def column(values: list[float]) -> Any:
        return np.array(values, dtype=np.float64)[:, np.newaxis]

    times = [call.skill.durations for _, call in arrivals]
    return Plans(
        arrival_s=column([(at_ns - zero_ns) / 1e9 for at_ns, _ in arrivals]),
        nominal_s=column([time.nominal_s for time in times]),
        least_s=column([time.least_s for time in times]),
        most_s=column([time.most_s for time in times]),
        token_s=column([(at_ns - zero_ns) / 1e9 for at_ns in record.token_ns]),
        shape=shape,
    )
