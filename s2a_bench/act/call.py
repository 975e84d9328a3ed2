"""A robot made of Python functions: one called with each action, or one per skill on a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Condition, Thread
from typing import ClassVar, TypeAlias

from s2a_bench.act import ActionKind, ActionRobot, Report, Running, SkillKind
from s2a_bench.clock import now_ns
from s2a_bench.errors import RobotError, UsageError
from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.registry import check_function, function_of
from s2a_bench.types import Vector


@dataclass(frozen=True, slots=True)
class PythonCall(SkillKind, ActionKind):
    """Call ``function``, written ``module:name``, with each action, float32 (D,), or each skill's `SkillMotion`.

    Its result is ignored. Actions are sent on the control loop's thread, which the function blocks. Each skill has its
    own thread; `CallableRobot` has one function per skill, and one for the gaps.
    """

    risk: ClassVar[str] = "program"

    function: str = ""

    def __post_init__(self) -> None:
        check_function(self.function)

    def open_skills(self, skills: SkillSet) -> CallableRobot:
        function = function_of(self.function, "`robot`: call")
        return CallableRobot(skills, dict.fromkeys((skill.name for skill in skills.skills), function))

    def open_actions(self, dims: int, period_ns: int) -> CallableActions:  # noqa: ARG002 - any action
        return CallableActions(self.function, function_of(self.function, "`robot`: call"))


class CallableActions(ActionRobot):
    def __init__(self, name: str, function: Callable[[Vector], object]) -> None:
        self._name, self._function = name, function

    def send(self, action: Vector | None, at_ns: int) -> None:  # noqa: ARG002 - at once
        if action is None:
            return
        try:
            self._function(action)
        except Exception as error:
            raise RobotError(f"`robot`: call: {self._name}: {type(error).__name__}: {error}") from error

    def describe(self) -> dict[str, str]:
        return {"robot": "call", "function": self._name}

    def close(self) -> None: ...


class SkillMotion:
    """Argument of a skill's function: the call and its commanded end, in ns of CLOCK_MONOTONIC, which may change."""

    def __init__(self, call: Call, end_ns: int) -> None:
        self.call, self.arguments = call, call.arguments
        self.aborted = False
        self._changed = Condition()
        self._end_ns = end_ns
        self._over = False

    @property
    def remaining_s(self) -> float:
        return max(self._end_ns - now_ns(), 0) / 1e9

    def wait(self, longest_s: float | None = None) -> bool:
        """Sleep until the present end, at most ``longest_s``, and return True; return False at once on an abort."""
        until_ns = None if longest_s is None else now_ns() + round(longest_s * 1e9)
        with self._changed:
            while not self.aborted:
                end_ns = self._end_ns if until_ns is None else min(self._end_ns, until_ns)
                left_ns = end_ns - now_ns()
                if left_ns <= 0:
                    return True
                self._changed.wait(left_ns / 1e9)
        return False

    def retime(self, end_ns: int) -> None:
        with self._changed:
            self._end_ns = end_ns
            self._changed.notify_all()

    def ended(self) -> bool:
        return self._over

    def abort(self) -> None:
        with self._changed:
            self.aborted = True
            self._changed.notify_all()

    def run(self, function: SkillFunction, report: Report) -> None:
        error = ""
        try:
            function(self)
        except Exception as failure:  # noqa: BLE001 - an exception of the user's code is the skill's outcome
            error = f"{type(failure).__name__}: {failure}"
        self._over = not error  # the executor waits for the report of a failure
        report(error)


SkillFunction: TypeAlias = Callable[[SkillMotion], object]
"""A skill as a function: returns when the skill is done, raises if it fails, checks ``motion.aborted``."""


class CallableRobot:
    def __init__(
        self, skills: SkillSet, functions: Mapping[str, SkillFunction], hold: Callable[[Gap], None] | None = None
    ) -> None:
        """Set the functions by the skills' names; raises UsageError for a skill without one.

        ``hold`` is called on the executor's thread to fill the time without a skill: stop, coast, hold or cruise.
        """
        if missing := [skill.name for skill in skills.skills if skill.name not in functions]:
            raise UsageError(f"`robot`: no function for the skills {', '.join(missing)} of '{skills.name}'")
        self._functions = functions
        self._fill = hold

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        motion = SkillMotion(call, end_ns)
        Thread(target=motion.run, args=(self._functions[call.skill.name], report), daemon=True).start()
        return motion

    def hold(self, gap: Gap) -> None:
        if self._fill is not None:
            self._fill(gap)

    def close(self) -> None: ...
