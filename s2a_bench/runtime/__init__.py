"""Acting: an `Executor` carries one policy's decisions out on a clock, and a `Robot` is what carries skills out.

    inbox = LiveInbox()
    executor = Executor(policy("stream-to-act"), shape, robot, inbox, SystemClock(), gap=skills.gap)
    feed = PlanFeed(Parser(format_), inbox.put)     # several executors may follow one stream
    feed.requested(now_ns())                        # on the thread that reads the tokens:
    for token in client.request(request, trace):
        feed.token(token.text, now_ns())
    feed.ended(now_ns())
    record = executor.run()                         # on a thread of its own

docs/executor.md says what happens when, and how a robot is plugged in.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import Protocol, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.plan import Call, Gap, SkillSet

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


class Robot(Protocol):
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


ENTRY_POINTS = "s2a_bench.robots"
"""The entry-point group under which other packages offer robots."""

ROBOTS: dict[str, str] = {
    "timed": "s2a_bench.runtime.timed:TimedRobot",
    "ros": "s2a_bench.runtime.actions:open_ros",
}
"""Value of ``--robot`` -> what builds it, called with the skill set; entry points add to these."""


def find_robot(name: str) -> Callable[[SkillSet], Robot]:
    """Return what builds a robot; raises UsageError for an unknown name, or one that cannot be loaded."""
    if name in ROBOTS:
        found: Callable[[SkillSet], Robot] = resolve_name(ROBOTS[name])
        return found
    offered = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    if name not in offered:
        known = ", ".join([*ROBOTS, *offered])
        raise UsageError(f"--robot: '{name}' is none of {known}; packages add robots as entry points '{ENTRY_POINTS}'")
    try:
        found = offered[name].load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"--robot {name}: {offered[name].value} cannot be loaded: {error}") from error
    return found
