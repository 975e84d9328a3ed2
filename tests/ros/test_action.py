"""What an action server remembers and decides, without DDS."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.errors import TransportError
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import ALL_GOALS, LISTED_ENDED, NEXT, CancelCode, Goals, Status, status_array

SECOND = 1_000_000_000


def goal_id(number: int) -> bytes:
    return number.to_bytes(16, "big")


def accepted(*stamps_ns: int, timeout_ns: int = 60 * SECOND) -> Goals:
    """Goals 1, 2 ... accepted at these times."""
    goals = Goals(timeout_ns)
    for number, stamp_ns in enumerate(stamps_ns, 1):
        assert goals.offer(goal_id(number))
        goals.accept(goal_id(number), stamp_ns)
    return goals


def ended(goals: Goals, number: int, now_ns: int = 0) -> None:
    goals.move(goal_id(number), Status.EXECUTING)
    goals.end(goal_id(number), Status.SUCCEEDED, "result", now_ns)


@pytest.mark.parametrize("present", [status for status in Status if status is not Status.UNKNOWN])
@pytest.mark.parametrize("wanted", list(Status))
def test_only_the_steps_of_the_state_machine_are_taken(present: Status, wanted: Status) -> None:
    goals = accepted(1)
    found = goals.find(goal_id(1))
    assert found is not None
    found.status = present
    if wanted in NEXT[present]:
        goals.move(goal_id(1), wanted)
        assert goals.status(goal_id(1)) == wanted
    else:
        with pytest.raises(TransportError, match=f"is {present.name} and cannot become {wanted.name}"):
            goals.move(goal_id(1), wanted)


@pytest.mark.parametrize(
    ("asked", "stamp_ns", "code", "chosen"),
    [
        (goal_id(2), 0, CancelCode.NONE, [2]),
        (goal_id(9), 0, CancelCode.UNKNOWN_GOAL_ID, []),
        (goal_id(4), 0, CancelCode.GOAL_TERMINATED, []),
        (goal_id(5), 0, CancelCode.GOAL_TERMINATED, []),
        (ALL_GOALS, 0, CancelCode.NONE, [1, 2, 3]),
        (ALL_GOALS, 20, CancelCode.NONE, [1, 2]),
        (goal_id(3), 10, CancelCode.NONE, [1, 3]),
        (goal_id(9), 10, CancelCode.NONE, [1]),
        (ALL_GOALS, 1, CancelCode.NONE, []),
    ],
)
def test_a_cancel_request_means_these_goals(asked: bytes, stamp_ns: int, code: CancelCode, chosen: list[int]) -> None:
    goals = accepted(10, 20, 30, 5, 6)
    ended(goals, 4)
    goals.move(goal_id(5), Status.CANCELING)
    got, canceling = goals.cancel(asked, stamp_ns)
    assert got == code
    assert [goal.id for goal in canceling] == [goal_id(number) for number in chosen]
    assert all(goals.status(goal.id) == Status.CANCELING for goal in canceling)


def test_results_expire_in_the_order_they_ended() -> None:
    goals = accepted(1, 2, 3, timeout_ns=10)
    ended(goals, 2, now_ns=100)
    ended(goals, 1, now_ns=105)
    goals.expire(110)
    assert [goals.status(goal_id(number)) for number in (1, 2, 3)] == [
        Status.SUCCEEDED,
        Status.UNKNOWN,
        Status.ACCEPTED,
    ]
    goals.expire(1000)
    assert [goal.id for goal in goals.listed()] == [goal_id(3)]


def test_the_status_array_lists_live_goals_and_the_latest_ended() -> None:
    goals = accepted(*range(1, 101))
    for number in range(2, 100):
        ended(goals, number)
    listed = [int.from_bytes(goal.id, "big") for goal in goals.listed()]
    assert listed == [1, *range(100 - LISTED_ENDED, 100), 100]


@pytest.mark.parametrize("count", [0, 1, 3])
def test_the_status_array_is_what_rosbags_writes(count: int) -> None:
    goals = accepted(*(1_700_000_000_123_456_789 + number for number in range(count)))
    if count:
        goals.move(goal_id(1), Status.EXECUTING)
    assert status_array(goals.listed()) == ros.serialise(_message(goals), "action_msgs/msg/GoalStatusArray")


def _message(goals: Goals) -> Any:
    entries = []
    for goal in goals.listed():
        entry = ros.default("action_msgs/msg/GoalStatus", status=int(goal.status))
        entry.goal_info.goal_id.uuid[:] = memoryview(goal.id)
        entry.goal_info.stamp.sec, entry.goal_info.stamp.nanosec = divmod(goal.stamp_ns, SECOND)
        entries.append(entry)
    return ros.default("action_msgs/msg/GoalStatusArray", status_list=entries)
