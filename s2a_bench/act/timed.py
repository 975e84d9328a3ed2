"""A robot that does nothing but take its time: every skill lasts exactly as long as it is told."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.act import Report, Running, SkillKind
from s2a_bench.plan import Call, Gap, SkillSet


class Timed(SkillKind):
    """Stands in for a robot wherever only the times matter: timelines, tests, demonstrations."""

    several: ClassVar[bool] = True

    def open_skills(self, skills: SkillSet) -> TimedRobot:
        """Take any skills."""
        del skills
        return TimedRobot()


class TimedRobot:
    """Waits, and is the skill that it waits for too: over whenever the executor says so."""

    def start(self, call: Call, end_ns: int, report: Report) -> Running:  # noqa: ARG002 - whatever it is
        return self

    def hold(self, gap: Gap) -> None:
        """Wait on."""

    def close(self) -> None:
        """Do nothing."""

    def retime(self, end_ns: int) -> None:
        """Be as patient as asked."""

    def ended(self) -> bool:
        return True

    def abort(self) -> None:
        """Be done at once."""
