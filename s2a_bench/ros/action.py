"""What a ROS 2 action server remembers and decides: goal states, cancelling, results that expire. No I/O, no clock.

After rcl_action: ``goal_state_machine.c``, ``action_server.c`` (rcl_action_process_cancel_request).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice
from typing import Any

from s2a_bench.errors import TransportError
from s2a_bench.ros import ALL_GOALS

CANCEL_GOAL = "action_msgs/srv/CancelGoal"
STATUS_ARRAY = "action_msgs/msg/GoalStatusArray"


class Status(IntEnum):
    """``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class CancelCode(IntEnum):
    """``action_msgs/srv/CancelGoal_Response.return_code``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


NEXT: dict[Status, frozenset[Status]] = {
    Status.UNKNOWN: frozenset({Status.ACCEPTED}),
    Status.ACCEPTED: frozenset({Status.EXECUTING, Status.CANCELING}),
    Status.EXECUTING: frozenset({Status.CANCELING, Status.SUCCEEDED, Status.ABORTED}),
    Status.CANCELING: frozenset({Status.SUCCEEDED, Status.CANCELED, Status.ABORTED}),
    Status.SUCCEEDED: frozenset(),
    Status.CANCELED: frozenset(),
    Status.ABORTED: frozenset(),
}
"""The goal state machine: status -> the statuses that may follow."""

LISTED_ENDED = 64
"""The status array lists all live goals and so many of the latest that ended."""

STATUS_ENTRY = struct.Struct("<16s3xiIb")
"""One GoalStatus in little-endian CDR: goal id, seconds, nanoseconds, status; the first goal id needs no padding."""


@dataclass(slots=True)
class Goal:
    """A goal that was accepted; ``stamp_ns`` is ROS time, ``ended_ns`` the time given to `Goals.end`."""

    id: bytes
    stamp_ns: int
    status: Status = Status.ACCEPTED
    result: Any = None
    ended_ns: int = 0


class Goals:
    """The goals of one action server. Not thread-safe: the owner locks."""

    def __init__(self, result_timeout_ns: int) -> None:
        """Remember ended goals for ``result_timeout_ns``."""
        self._timeout_ns = result_timeout_ns
        self._offered: set[bytes] = set()
        self._live: dict[bytes, Goal] = {}
        self._ended: dict[bytes, Goal] = {}

    def offer(self, goal_id: bytes) -> bool:
        """Note a goal that waits for a decision; False if its id is taken."""
        if goal_id in self._offered or self.find(goal_id):
            return False
        self._offered.add(goal_id)
        return True

    def reject(self, goal_id: bytes) -> None:
        """Forget an offered goal; raises TransportError if it was decided already."""
        if goal_id not in self._offered:
            raise TransportError(f"goal {goal_id.hex()} was accepted or rejected already")
        self._offered.remove(goal_id)

    def accept(self, goal_id: bytes, stamp_ns: int) -> None:
        """Take an offered goal; raises TransportError if it was decided already."""
        self.reject(goal_id)
        self._live[goal_id] = Goal(goal_id, stamp_ns)

    def find(self, goal_id: bytes) -> Goal | None:
        """Return a goal that is remembered."""
        return self._live.get(goal_id) or self._ended.get(goal_id)

    def status(self, goal_id: bytes) -> Status:
        """Return a goal's status, UNKNOWN if it is not remembered."""
        goal = self.find(goal_id)
        return goal.status if goal else Status.UNKNOWN

    def move(self, goal_id: bytes, status: Status) -> None:
        """Change the status of a live goal; raises TransportError where the state machine does not allow it."""
        present = self.status(goal_id)
        if status not in NEXT[present]:
            raise TransportError(f"goal {goal_id.hex()} is {present.name} and cannot become {status.name}")
        self._live[goal_id].status = status

    def end(self, goal_id: bytes, status: Status, result: Any, now_ns: int) -> None:
        """End a goal with its result, which is kept; raises TransportError like `move`."""
        self.move(goal_id, status)
        goal = self._live.pop(goal_id)
        goal.result, goal.ended_ns = result, now_ns
        self._ended[goal_id] = goal

    def cancel(self, goal_id: bytes, stamp_ns: int) -> tuple[CancelCode, list[Goal]]:
        """Select the goals a cancel request means, make them CANCELING, and return them with the return code."""
        if goal_id != ALL_GOALS and not stamp_ns:
            goal = self.find(goal_id)
            if goal is None:
                return CancelCode.UNKNOWN_GOAL_ID, []
            if Status.CANCELING not in NEXT[goal.status]:
                return CancelCode.GOAL_TERMINATED, []
            chosen = [goal]
        else:
            everything = goal_id == ALL_GOALS and not stamp_ns
            chosen = [
                goal
                for goal in self._live.values()
                if Status.CANCELING in NEXT[goal.status]
                and (everything or goal.stamp_ns <= stamp_ns or goal.id == goal_id)
            ]
        for goal in chosen:
            goal.status = Status.CANCELING
        return CancelCode.NONE, chosen

    def expire(self, now_ns: int) -> None:
        """Forget goals that ended ``result_timeout_ns`` ago."""
        while self._ended:
            goal = next(iter(self._ended.values()))
            if goal.ended_ns + self._timeout_ns > now_ns:
                return
            del self._ended[goal.id]

    def listed(self) -> list[Goal]:
        """Return what the status array shows, in order of acceptance."""
        latest = islice(reversed(self._ended.values()), LISTED_ENDED)
        return sorted((*self._live.values(), *latest), key=lambda goal: goal.stamp_ns)


def status_array(goals: list[Goal]) -> bytearray:
    """Write an ``action_msgs/msg/GoalStatusArray`` as CDR; by hand, because it is sent with every step of a goal."""
    entries = b"".join(STATUS_ENTRY.pack(goal.id, *divmod(goal.stamp_ns, 1_000_000_000), goal.status) for goal in goals)
    padding = 3 if goals else 0
    head = struct.pack("<4BI", 0, 1, 0, padding, len(goals))
    return bytearray(head + entries[:16] + entries[19:] + bytes(padding))
