"""Actions and skills to a Python function that is named."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from s2a_bench.act import ActionKind, SkillKind, kind
from s2a_bench.errors import RobotError, UsageError
from s2a_bench.plan import load_skills


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType("somebodys_arm")
    monkeypatch.setitem(sys.modules, "somebodys_arm", module)
    return module


def test_the_function_gets_each_action_and_no_stall(arm: ModuleType) -> None:
    seen: list[list[float]] = []
    arm.move = lambda action: seen.append(action.tolist())  # type: ignore[attr-defined]
    robot = kind("call?function=somebodys_arm:move", ActionKind).open_actions(2, 1)
    for action in (np.array([1, 2], np.float32), None, np.array([3, 4], np.float32)):
        robot.send(action, 0)
    assert seen == [[1, 2], [3, 4]]
    assert robot.state() == ()
    assert robot.describe() == {"robot": "call", "function": "somebodys_arm:move"}
    robot.close()


def test_what_it_raises_ends_the_run_with_one_line_that_names_it(arm: ModuleType) -> None:
    def move(_: object) -> None:
        raise ValueError("joint 3\nis at its limit")

    arm.move = move  # type: ignore[attr-defined]
    robot = kind("call?function=somebodys_arm:move", ActionKind).open_actions(1, 1)
    with pytest.raises(RobotError) as error:
        robot.send(np.zeros(1, np.float32), 0)
    assert str(error.value) == r"`robot`: call: somebodys_arm:move: ValueError: joint 3\nis at its limit"


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("call", "`robot`: call: function = '' should look like module:name"),
        ("call?function=move", "`robot`: call: function = 'move' should look like module:name"),
        ("call?function=somebodys_arm:wave", "`robot`: call: somebodys_arm:wave does not load: AttributeError"),
        ("call?function=no_such_arm:move", "`robot`: call: no_such_arm:move does not load: ModuleNotFoundError"),
        (
            "call?function=somebodys_arm:joints",
            "`robot`: call: somebodys_arm:joints cannot be called: it is of type int",
        ),
    ],
)
def test_what_is_no_function_is_refused(arm: ModuleType, written: str, message: str) -> None:
    arm.joints = 7  # type: ignore[attr-defined]
    with pytest.raises(UsageError) as error:
        kind(written, ActionKind).open_actions(1, 1)
    assert message in str(error.value)
    with pytest.raises(UsageError) as again:
        kind(written, SkillKind).open_skills(load_skills("household"))
    assert str(again.value) == str(error.value)
