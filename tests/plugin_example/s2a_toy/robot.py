"""The robot `toy-robot`: writes down what it is told, actions and skills, a line each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from s2a_bench.act import ActionKind, ActionRobot, Report, Running, SkillKind

if TYPE_CHECKING:
    from s2a_bench.plan import Call, Gap, SkillSet
    from s2a_bench.types import Vector


@dataclass(frozen=True, slots=True)
class ToyRobot(SkillKind, ActionKind):
    """Writes to the file ``log``."""

    several: ClassVar[bool] = True

    log: str = "toy-robot.txt"

    def open_skills(self, skills: SkillSet) -> Scribe:
        """Take any skills."""
        del skills
        return Scribe(Path(self.log))

    def open_actions(self, dims: int, period_ns: int) -> Scribe:
        """Take any actions."""
        del dims, period_ns
        return Scribe(Path(self.log))


class Scribe(ActionRobot):
    """One opened robot, which is the skill that runs, too: each is over whenever the executor says so."""

    def __init__(self, log: Path) -> None:
        """Open the file."""
        self._file = log.open("a", encoding="utf-8")
        self._count = 0

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Write an action down."""
        del at_ns
        self._count += 1
        self._file.write("hold\n" if action is None else f"action {' '.join(f'{value:.3f}' for value in action)}\n")

    def state(self) -> tuple[float, ...]:
        """Return how often it was told something."""
        return (float(self._count),)

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        """Write a skill down."""
        del end_ns, report
        self._file.write(f"skill {call}\n")
        return self

    def hold(self, gap: Gap) -> None:
        """Wait on."""

    def retime(self, end_ns: int) -> None:
        """Be as patient as asked."""

    def ended(self) -> bool:
        """Be over when asked."""
        return True

    def abort(self) -> None:
        """Be done at once."""

    def describe(self) -> dict[str, str]:
        """Say who it is."""
        return {"robot": "toy-robot"}

    def close(self) -> None:
        """Close the file."""
        self._file.close()
