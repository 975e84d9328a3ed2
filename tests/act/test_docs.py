"""The examples of docs/executor.md do what the page says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.act import ROBOTS, events
from s2a_bench.act.call import SkillMotion
from s2a_bench.act.events import VirtualInbox
from s2a_bench.clock import VirtualClock, now_ns
from s2a_bench.plan import load_skills

PAGE = (Path(__file__).parent.parent.parent / "docs" / "executor.md").read_text()
ARM, PROGRAM = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_example_package_makes_a_robot(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(ARM, names)  # noqa: S102 - our own page
    household = load_skills("household")
    names["MyArm"]().open_skills(household).hold("coast")
    motion = SkillMotion(household.calls[-1], now_ns())
    names["pick"](motion)
    stopped = SkillMotion(household.calls[-1], now_ns() + 10**12)
    stopped.abort()
    names["pick"](stopped)
    assert capsys.readouterr().out.splitlines()[-1] == "stopping"
    assert f'[project.entry-points."{ROBOTS.group}"]' in PAGE


def test_the_example_program_carries_a_plan_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = VirtualClock(5)
    monkeypatch.setattr("s2a_bench.clock.SystemClock", lambda: clock)
    monkeypatch.setattr(events, "LiveInbox", lambda: VirtualInbox(clock))
    exec(PROGRAM, {})  # noqa: S102 - our own page
    assert capsys.readouterr().out == "completed [0] ['pick(cup)', 'pick(box)']\n"
    assert clock.now_ns() == 5 + 4 * 10**9


def test_the_page_names_every_outcome() -> None:
    from typing import get_args

    from s2a_bench.act.record import Outcome

    outcomes = {name for part in get_args(Outcome) for name in (get_args(part) or (part,))}
    assert outcomes == set(re.findall(r"`([a-z-]+)`", "".join(re.findall(r"^\| (`[a-z].*?) \|", PAGE, re.MULTILINE))))
