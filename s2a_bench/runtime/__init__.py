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
from typing import Final, Protocol, TypeAlias

from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.registry import Registry

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


ROBOTS: Final[Registry[Callable[[SkillSet], Robot]]] = Registry(
    "robots", "robot", {"timed": "s2a_bench.runtime.timed:TimedRobot", "ros": "s2a_bench.runtime.actions:open_ros"}
)
"""What builds each robot for a skill set."""
