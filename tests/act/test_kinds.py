"""Robots by their names: which carry out skills, which take actions, and those of other packages."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Any

import pytest

from s2a_bench.act import ROBOTS, ActionKind, ActionRobot, SkillKind, SkillRobot, kind
from s2a_bench.act.call import CallableRobot
from s2a_bench.errors import UsageError
from s2a_bench.plan import SkillSet, load_skills


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A package that offers a robot."""
    module = ModuleType("somebodys_arm")
    monkeypatch.setitem(sys.modules, "somebodys_arm", module)
    point = EntryPoint("arm", "somebodys_arm:arm", ROBOTS.group)
    monkeypatch.setitem(vars(ROBOTS), "_offered", {"arm": point})
    return module


def test_each_of_ours_can_do_one_or_both() -> None:
    found = {name: (issubclass(ROBOTS[name], SkillKind), issubclass(ROBOTS[name], ActionKind)) for name in ROBOTS}
    assert found == {"timed": (True, False), "ros": (True, True), "call": (True, True), "gym": (False, True)}


@pytest.mark.parametrize(
    ("written", "able", "message"),
    [
        ("gym?env=Moon-v0", SkillKind, "`robot`: gym carries out no skills; timed, ros, call do"),
        ("timed", ActionKind, "`robot`: timed takes no actions; ros, call, gym do"),
    ],
)
def test_one_that_cannot_is_refused_with_those_that_can(written: str, able: Any, message: str) -> None:
    with pytest.raises(UsageError) as error:
        kind(written, able)
    assert str(error.value) == message


def test_one_of_another_package_is_found_by_its_name(offer: ModuleType) -> None:
    class Joints(ActionRobot):
        def __init__(self, dims: int) -> None:
            self._dims = dims

        def state(self) -> tuple[float, ...]:
            return (0.0,) * self._dims

    @dataclass(frozen=True)
    class Arm(SkillKind, ActionKind):
        stiff: bool = False

        def open_skills(self, skills: SkillSet) -> SkillRobot:
            return CallableRobot(skills, {skill.name: lambda _: None for skill in skills.skills})

        def open_actions(self, dims: int, period_ns: int) -> ActionRobot:  # noqa: ARG002 - at any rate
            return Joints(dims)

    offer.arm = Arm  # type: ignore[attr-defined]
    assert kind("arm?stiff=true", SkillKind) == Arm(stiff=True)
    assert isinstance(kind("arm", SkillKind).open_skills(load_skills("household")), CallableRobot)
    assert kind("arm?stiff=true", ActionKind).open_actions(3, 1).state() == (0, 0, 0)
    with pytest.raises(UsageError, match="`robot`: arm: 'soft' is not a parameter; its parameters are stiff"):
        kind("arm?soft=true", ActionKind)
    with pytest.raises(UsageError, match="`robot`: timed takes no actions; ros, call, arm do"):
        kind("timed", ActionKind)


@pytest.mark.parametrize(("able", "lacks"), [(SkillKind, "carries out no skills"), (ActionKind, "takes no actions")])
def test_one_that_declares_nothing_can_do_nothing(offer: ModuleType, able: Any, lacks: str) -> None:
    offer.arm = lambda skills: skills  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match=f"`robot`: arm {lacks}; "):
        kind("arm", able)
