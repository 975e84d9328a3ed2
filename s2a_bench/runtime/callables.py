"""A robot made of Python functions: one a skill, each run on a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from threading import Condition, Thread
from typing import TypeAlias

from s2a_bench.clock import now_ns
from s2a_bench.errors import UsageError
from s2a_bench.plan import Call, Gap, SkillSet, Value
from s2a_bench.runtime import Report, Running


class Motion:
    """What a skill's function is given: the call, and how long it may take, which can change on the way."""

    def __init__(self, call: Call, end_ns: int) -> None:
        """End at ``end_ns`` of CLOCK_MONOTONIC unless told otherwise."""
        self.call = call
        self._changed = Condition()
        self._end_ns = end_ns
        self._aborted = self._over = False

    @property
    def arguments(self) -> dict[str, Value]:
        """Return the values of the call by their names."""
        return self.call.arguments

    @property
    def aborted(self) -> bool:
        """Return whether to stop as soon as that is safe."""
        return self._aborted

    @property
    def remaining_s(self) -> float:
        """Return how long is left until the commanded end, in s; 0 when it is past."""
        return max(self._end_ns - now_ns(), 0) / 1e9

    def wait(self, longest_s: float | None = None) -> bool:
        """Sleep until the end as it stands by then, at most ``longest_s``; return at once, False, on an abort."""
        until_ns = None if longest_s is None else now_ns() + round(longest_s * 1e9)
        with self._changed:
            while not self._aborted:
                end_ns = self._end_ns if until_ns is None else min(self._end_ns, until_ns)
                left_ns = end_ns - now_ns()
                if left_ns <= 0:
                    return True
                self._changed.wait(left_ns / 1e9)
        return False

    def retime(self, end_ns: int) -> None:
        """End at another time."""
        with self._changed:
            self._end_ns = end_ns
            self._changed.notify_all()

    def ended(self) -> bool:
        """Return whether the function has returned."""
        return self._over

    def abort(self) -> None:
        """Make `wait` return, and ``aborted`` true."""
        with self._changed:
            self._aborted = True
            self._changed.notify_all()

    def run(self, action: Action, report: Report) -> None:
        """Call the function and report how it went."""
        error = ""
        try:
            action(self)
        except Exception as failure:  # noqa: BLE001 - the user's code; what it raises is the skill's outcome
            error = f"{type(failure).__name__}: {failure}"
        self._over = not error  # what failed has to be heard of
        report(error)


Action: TypeAlias = Callable[[Motion], None]
"""A skill as a function: returns when the skill is done, raises where it fails, looks after ``motion.aborted``."""


class CallableRobot:
    """Calls one function a skill."""

    def __init__(
        self, skills: SkillSet, actions: Mapping[str, Action], hold: Callable[[Gap], None] | None = None
    ) -> None:
        """Take the functions by the skills' names; raises UsageError where a skill has none.

        ``hold`` fills the time without a skill: stop, coast, hold or cruise. It runs on the executor's thread.
        """
        if missing := [skill.name for skill in skills.skills if skill.name not in actions]:
            raise UsageError(f"`robot`: no function for the skills {', '.join(missing)} of '{skills.name}'")
        self._actions = actions
        self._fill = hold

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        """Call the skill's function on a new thread, which does not keep the process alive."""
        motion = Motion(call, end_ns)
        Thread(target=motion.run, args=(self._actions[call.skill.name], report), daemon=True).start()
        return motion

    def hold(self, gap: Gap) -> None:
        """Fill the gap as the user does."""
        if self._fill is not None:
            self._fill(gap)

    def close(self) -> None:
        """Do nothing: functions end by themselves."""
