"""Acting: an `Executor` carries out one policy's decisions, a `ControlLoop` a chunk's actions, and robots take both.

docs/executor.md and docs/chunks-live.md say what happens when, and how a robot is plugged in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Final, Protocol, TypeAlias, TypeGuard, TypeVar

from s2a_bench.errors import UsageError
from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.policy.parameters import build
from s2a_bench.registry import Registry
from s2a_bench.types import Vector

if TYPE_CHECKING:
    from typing import TypeGuard

    from s2a_bench.act.plant import PlantMotion
    from s2a_bench.policy import Floats

Report: TypeAlias = Callable[[str], None]
"""Called once, from any thread, when a skill has ended by itself: with nothing, or with what went wrong."""


class Running(Protocol):
    """A skill that a robot is carrying out."""

    def retime(self, end_ns: int) -> None:
        """End at ``end_ns`` instead: later (extend) or sooner, perhaps now (compress)."""
        ...

    def ended(self) -> bool:
        """Tell, at the commanded end, whether it is over; if not, it will report that it is."""
        ...

    def abort(self) -> None:
        """Stop as soon as that is safe."""
        ...


class SkillRobot(Protocol):
    """What carries skills out, one at a time. Called on the executor's thread: every call returns at once.

    What a call raises ends the plan with the outcome ``skill-failed``.
    """

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        """Start a skill that should end at ``end_ns`` (CLOCK_MONOTONIC)."""
        ...

    def hold(self, gap: Gap) -> None:
        """Fill the time until the next skill, or until the next plan: no skill is valid now."""
        ...

    def close(self) -> None:
        """Let go of the robot; may be called twice."""
        ...


class ActionRobot(Protocol):
    """What carries actions out. One thread, the control loop's, calls it, and every call returns at once."""

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Execute an action, float32 (D,), from ``at_ns`` (CLOCK_MONOTONIC) until the next tick; called in every tick.

        None is a stall: hold. The array is only lent. Raises S2AError, which ends the run.
        """
        ...

    def state(self) -> tuple[float, ...]:
        """Return what a request tells the policy of the robot, in the robot's own units; empty: nothing."""
        ...

    def moved(self, most: int) -> tuple[PlantMotion, Floats] | None:  # noqa: ARG002 - for subclasses
        """Return how it moved from the first action on, and under which actions, ``most`` ticks; None: unknown."""
        return None

    def describe(self) -> dict[str, str]:
        """Return what it is, for the manifest."""
        ...

    def close(self) -> None:
        """Let go of the robot; may be called twice."""
        ...


class RobotKind:
    """A kind of robot with its parameters: the fields of a frozen dataclass, which all have defaults.

    What it can do it declares by what it is derived from: `SkillKind`, `ActionKind`, or both.
    """

    risk: ClassVar[str] = ""
    """``program`` where a parameter names code that it runs: a file of somebody else's should not choose it."""


class SkillKind(RobotKind):
    """A kind of robot that carries out skills."""

    lacks: ClassVar[str] = "carries out no skills"
    several: ClassVar[bool] = False
    """Whether any number may be open side by side, each with a policy of its own: nothing moves."""

    def open_skills(self, skills: SkillSet) -> SkillRobot:
        """Open a robot for the skills of a set; raises S2AError."""
        raise NotImplementedError


class ActionKind(RobotKind):
    """A kind of robot that takes an action a control tick."""

    lacks: ClassVar[str] = "takes no actions"
    simulated: ClassVar[bool] = False
    """Whether it follows from its actions how it moves, as `respond` says."""

    def open_actions(self, dims: int, period_ns: int) -> ActionRobot:
        """Open a robot for actions of ``dims`` numbers, one every ``period_ns``; raises S2AError."""
        raise NotImplementedError

    def respond(self, actions: Floats, period_s: float) -> PlantMotion:
        """Return the motion under actions of shape (K, D), K >= 1, one every ``period_s``; NaN: the last one is held.

        Raises ValueError for a first action that is NaN.
        """
        raise NotImplementedError


ROBOTS: Final[Registry[type[RobotKind]]] = Registry(
    "robots",
    "robot",
    {
        "timed": "s2a_bench.act.timed:Timed",
        "plant": "s2a_bench.act.plant:Plant",
        "ros": "s2a_bench.act.ros:RosRobot",
        "call": "s2a_bench.act.call:PythonCall",
    },
)
"""Every kind of robot, whichever of the two it can do."""

_Able = TypeVar("_Able", SkillKind, ActionKind)


def kind(written: str, able: type[_Able]) -> _Able:
    """Build the kind ``name[?parameter=value&...]`` of those that can do what is asked, `SkillKind` or `ActionKind`.

    Raises UsageError for an unknown name, parameter or value; for one that cannot, with the names of those that can.
    """
    name = written.partition("?")[0]
    made_by = ROBOTS[name]
    if not _is(made_by, able):
        those = ", ".join(each for each, other in ROBOTS.loaded() if _is(other, able))
        raise UsageError(f"`{ROBOTS.field}`: {name} {able.lacks}; {those} do")
    return build(made_by, written, ROBOTS.field)


def open_robot(written: str, dims: int, period_ns: int) -> ActionRobot:
    """Open the robot ``name[?parameter=value&...]`` for actions; raises S2AError for what the caller can mend."""
    return kind(written, ActionKind).open_actions(dims, period_ns)


def _is(entry: object, able: type[_Able]) -> TypeGuard[type[_Able]]:
    """Return whether an entry is such a kind; another package may have offered anything."""
    return isinstance(entry, type) and issubclass(entry, able)
