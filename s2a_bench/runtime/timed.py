"""A robot that does nothing but take its time: every skill lasts exactly as long as it is told."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.runtime import Report, Running


class TimedRobot:
    """Stands in for a robot wherever only the times matter: timelines, tests, demonstrations."""

    several: ClassVar[bool] = True
    """Any number may run side by side: nothing moves."""

    def __init__(self, skills: SkillSet | None = None) -> None:
        """Take any skills."""
        del skills

    def start(self, call: Call, end_ns: int, report: Report) -> Running:  # noqa: ARG002 - whatever it is
        """Begin to wait."""
        return _Waiting()

    def hold(self, gap: Gap) -> None:
        """Wait on."""

    def close(self) -> None:
        """Do nothing."""


class _Waiting:
    """Over whenever the executor says so."""

    def retime(self, end_ns: int) -> None:
        """Be as patient as asked."""

    def ended(self) -> bool:
        """Be done on time."""
        return True

    def abort(self) -> None:
        """Be done at once."""
