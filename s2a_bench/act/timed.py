"""A robot that only waits: every skill lasts exactly as long as commanded."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.act import Report, Running, SkillKind
from s2a_bench.plan import Call, Gap, SkillSet


class Timed(SkillKind):
    """A robot for timelines, tests and demonstrations, where only times matter."""

    several: ClassVar[bool] = True

    def open_skills(self, skills: SkillSet) -> TimedRobot:  # noqa: ARG002 - any skill
        return TimedRobot()


class TimedRobot:
    """Robot and running skill in one object: a skill is over at its commanded end."""

    def start(self, call: Call, end_ns: int, report: Report) -> Running:  # noqa: ARG002 - all skills are the same
        return self

    def hold(self, gap: Gap) -> None: ...

    def close(self) -> None: ...

    def retime(self, end_ns: int) -> None: ...

    def ended(self) -> bool:
        return True

    def abort(self) -> None: ...
