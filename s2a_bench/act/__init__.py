"""Acting: an `Executor` carries out a policy's decisions; robots execute its skills, or actions at a control rate.

docs/executor.md defines the timing, and shows how a robot is plugged in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol, TypeAlias, TypeGuard, TypeVar

from s2a_bench.errors import UsageError
from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.policy.parameters import build
from s2a_bench.registry import Registry
from s2a_bench.types import Pixels, Vector

Report: TypeAlias = Callable[[str], None]
"""Called once, from any thread, when a skill has ended by itself: with an error, empty on success."""


class Running(Protocol):
    def retime(self, end_ns: int) -> None:
        """End at ``end_ns`` instead: later (extend) or sooner, perhaps now (compress)."""

    def ended(self) -> bool:
        """Return, at the commanded end, whether it is over; if not, it reports its end later."""

    def abort(self) -> None:
        """Stop as soon as that is safe."""


class SkillRobot(Protocol):
    """A robot that executes skills, one at a time. Called on the executor's thread: every call returns at once.

    An exception ends the plan with the outcome ``skill-failed``.
    """

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        """Start a skill that should end at ``end_ns`` (CLOCK_MONOTONIC)."""

    def hold(self, gap: Gap) -> None:
        """Fill the time until the next skill or plan."""

    def close(self) -> None:
        """Let go of the robot; may be called twice."""


class ActionRobot(Protocol):
    """A robot that executes actions. Called on the control loop's thread: every call returns at once."""

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Execute an action, float32 (D,), from ``at_ns`` (CLOCK_MONOTONIC) until the next tick; called in every tick.

        None is a stall: hold. The array is not to be kept. Raises S2AError, which ends the run.
        """

    def state(self) -> tuple[float, ...]:
        """Return the state that a request sends to the policy, in the robot's units; empty: none."""
        return ()

    def picture(self) -> Pixels | None:
        """Return the picture that a request sends, of this tick, uint8 (height, width, 3) RGB; None: a camera's."""
        return None

    def describe(self) -> dict[str, str]:
        """Return its parameters for the manifest."""

    def close(self) -> None:
        """Let go of the robot; may be called twice."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of an episode, in s and in the units of its actions or of the tracked position."""

    success: bool
    reward: float
    """The sum of its rewards."""
    path: float
    """Length of the path."""
    jerk: float
    """Root mean square of the third difference of one tick and the next, by the period's cube."""


class TaskRobot(ActionRobot):
    """A robot with a task in a world that it steps, once in every `send`; a task is done in episodes."""

    over: bool = False
    """Whether the episode has ended; the next `send` would begin another one."""

    def begin(self, seed: int) -> None:
        """Begin an episode, which the seed determines."""

    def outcome(self) -> Outcome:
        """Return how the episode has gone so far; raises RobotError where the world does not say."""
        raise NotImplementedError


class RobotKind:
    """A kind of robot, a `SkillKind`, an `ActionKind` or both: a frozen dataclass whose fields all have defaults."""

    risk: ClassVar[str] = ""
    """``program`` if a parameter names code to run: a file from another person should not choose it."""


class SkillKind(RobotKind):
    lacks: ClassVar[str] = "carries out no skills"
    several: ClassVar[bool] = False
    """Whether several may be open at once, one per policy: nothing moves."""

    def open_skills(self, skills: SkillSet) -> SkillRobot:
        """Open a robot for the skills of a set; raises S2AError."""
        raise NotImplementedError


class ActionKind(RobotKind):
    """A kind of robot that takes one action per control tick."""

    lacks: ClassVar[str] = "takes no actions"

    def open_actions(self, dims: int, period_ns: int) -> ActionRobot:
        """Open a robot for actions of ``dims`` numbers, one every ``period_ns``; raises S2AError."""
        raise NotImplementedError


class TaskKind(ActionKind):
    """A kind of robot that does a task in a world of its own."""

    lacks = "does no task"

    @property
    def period_ns(self) -> int:
        """Return the control period of its world; raises S2AError."""
        raise NotImplementedError

    def open_actions(self, dims: int, period_ns: int) -> TaskRobot:
        """Open its world, which moves on by one step in every period, however long that is."""
        raise NotImplementedError


ROBOTS: Final[Registry[type[RobotKind]]] = Registry(
    "robots",
    "robot",
    {
        "timed": "s2a_bench.act.timed:Timed",
        "ros": "s2a_bench.act.ros:RosRobot",
        "call": "s2a_bench.act.call:PythonCall",
    },
)

_Able = TypeVar("_Able", SkillKind, ActionKind, TaskKind)


def kind(written: str, able: type[_Able]) -> _Able:
    """Build the kind ``name[?parameter=value&...]`` derived from ``able``, `SkillKind`, `ActionKind` or `TaskKind`.

    Raises UsageError for an unknown name, parameter or value, and for another kind, with the names of suitable ones.
    """
    name = written.partition("?")[0]
    made_by = ROBOTS[name]
    if not _is(made_by, able):
        those = ", ".join(each for each, other in ROBOTS.loaded() if _is(other, able))
        raise UsageError(f"`{ROBOTS.field}`: {name} {able.lacks}; {those} {'do' if ',' in those else 'does'}")
    return build(made_by, written, ROBOTS.field)


def _is(entry: object, able: type[_Able]) -> TypeGuard[type[_Able]]:
    return isinstance(entry, type) and issubclass(entry, able)
