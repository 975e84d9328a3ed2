"""Record of an executor: the skills as they ran, the commands to the robot, and the outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from s2a_bench.act.events import Fault
from s2a_bench.plan import Call
from s2a_bench.policy import Floats, Plans, PlanShape, Schedule

Outcome: TypeAlias = Literal["completed", "short", "skill-failed", "skill-overran", "aborted"] | Fault
"""How a plan ended. ``short``: the stream ended normally with fewer skills than announced, all executed."""

What: TypeAlias = Literal["start", "extend", "compress", "end", "hold", "abort"]


@dataclass(slots=True)
class SkillRun:
    """One started skill; times are on the executor's clock, in ns."""

    index: int
    call: Call
    arrival_ns: int
    due_ns: int
    """When the start was due: the time set by the policy, an arrival, or the end of the skill before."""
    ordered_ns: int
    """When the command was sent; durations count from it."""
    start_ns: int
    """When the robot had accepted the command."""
    duration_ns: int
    """The policy's first duration."""
    latest_ns: int
    """The longest duration while the next skill is missing."""
    until_ns: int
    """The last commanded end."""
    end_ns: int | None = None
    """None while it runs."""

    @property
    def jitter_ns(self) -> int:
        return self.start_ns - self.due_ns


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """A command to the robot; ``index`` is the skill's, -1 for a hold before the first."""

    at_ns: int
    what: What
    index: int


@dataclass(slots=True)
class Record:
    """One plan under one policy, filled while it runs."""

    policy: str
    requested_ns: int | None = None
    token_ns: list[int] = field(default_factory=list)
    arrivals: list[tuple[int, Call]] = field(default_factory=list)
    ended_ns: int | None = None
    """When the stream ended or broke."""
    skills: list[SkillRun] = field(default_factory=list)
    commands: list[RobotCommand] = field(default_factory=list)
    extra: int = 0
    """Skills beyond those announced, which are not executed."""
    outcome: Outcome | None = None
    """None while it runs."""
    why: str = ""

    @property
    def ran(self) -> list[SkillRun]:
        return [skill for skill in self.skills if skill.end_ns is not None]

    @property
    def stalls_ns(self) -> list[int]:
        return [after.start_ns - (before.end_ns or 0) for before, after in zip(self.ran, self.skills[1:], strict=False)]


def observed(record: Record, shape: PlanShape) -> Plans | None:
    """Return the received plan, one column with tokens and ``shape``; None if it is incomplete."""
    zero_ns, arrivals = record.requested_ns, record.arrivals[: shape.n_skills]
    if zero_ns is None or len(arrivals) < shape.n_skills or not record.token_ns:
        return None
    return _plans(zero_ns, arrivals, token_s=_since(zero_ns, record.token_ns), shape=shape)


def executed(record: Record) -> tuple[Plans, Schedule, Floats]:
    """Return the skills that ran, and when they were due: columns of shape (N, 1), in s from the request."""
    zero_ns, ran = record.requested_ns or 0, record.ran
    start_s = _since(zero_ns, [skill.start_ns for skill in ran])
    duration_s = _column([((skill.end_ns or 0) - skill.start_ns) / 1e9 for skill in ran])
    due_s = _since(zero_ns, [skill.due_ns for skill in ran])
    plans = _plans(zero_ns, [(skill.arrival_ns, skill.call) for skill in ran])
    return plans, Schedule(start_s, duration_s), due_s


def _plans(zero_ns: int, arrivals: Sequence[tuple[int, Call]], **more: Any) -> Plans:
    times = [call.skill.durations for _, call in arrivals]
    return Plans(
        arrival_s=_since(zero_ns, [at_ns for at_ns, _ in arrivals]),
        nominal_s=_column([time.nominal_s for time in times]),
        least_s=_column([time.least_s for time in times]),
        most_s=_column([time.most_s for time in times]),
        **more,
    )


def _since(zero_ns: int, times_ns: Sequence[int]) -> Floats:
    return _column([(at_ns - zero_ns) / 1e9 for at_ns in times_ns])


def _column(values: Sequence[float]) -> Floats:
    return np.array(values, dtype=np.float64)[:, np.newaxis]
