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
from s2a_bench.plugins.chunks.plant import Plant


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
    assert found == {"timed": (True, False), "plant": (False, True), "ros": (True, True), "call": (True, True)}


@pytest.mark.parametrize(
    ("written", "able", "message"),
    [
        ("plant?damping=2", SkillKind, "`robot`: plant carries out no skills; timed, ros, call do"),
        ("timed", ActionKind, "`robot`: timed takes no actions; ros, call, plant do"),
    ],
)
def test_one_that_cannot_is_refused_with_those_that_can(written: str, able: Any, message: str) -> None:
    with pytest.raises(UsageError) as error:
        kind(written, able)
    assert str(error.value) == message


def test_one_of_another_package_is_found_by_its_name(offer: ModuleType) -> None:
    @dataclass(frozen=True)
    class Arm(SkillKind, ActionKind):
        stiff: bool = False

        def open_skills(self, skills: SkillSet) -> SkillRobot:
            return CallableRobot(skills, {skill.name: lambda _: None for skill in skills.skills})

        def open_actions(self, dims: int, period_ns: int) -> ActionRobot:
            return Plant(20.0 if self.stiff else 2.0).open_actions(dims, period_ns)

    offer.arm = Arm  # type: ignore[attr-defined]
    assert kind("arm?stiff=true", SkillKind) == Arm(stiff=True)
    assert isinstance(kind("arm", SkillKind).open_skills(load_skills("household")), CallableRobot)
    assert kind("arm?stiff=true", ActionKind).open_actions(1, 1).describe()["frequency_hz"] == "20"
    with pytest.raises(UsageError, match="`robot`: arm: 'soft' is no parameter; its parameters are stiff"):
        kind("arm?soft=true", ActionKind)
    with pytest.raises(UsageError, match="`robot`: timed takes no actions; ros, call, arm do"):
        kind("timed", ActionKind)


@pytest.mark.parametrize(("able", "lacks"), [(SkillKind, "carries out no skills"), (ActionKind, "takes no actions")])
def test_one_that_declares_nothing_can_do_nothing(offer: ModuleType, able: Any, lacks: str) -> None:
    offer.arm = lambda skills: skills  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match=f"`robot`: arm {lacks}; "):
        kind("arm", able)
