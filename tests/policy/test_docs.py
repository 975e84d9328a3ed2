"""The example of docs/policies.md is a policy like ours."""

from __future__ import annotations

import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

from s2a_bench.policy import POLICIES, Policy, policies
from s2a_bench.policy import policy as build
from s2a_bench.testing.policy import PolicySuite

PAGE = (Path(__file__).parent.parent.parent / "docs" / "policies.md").read_text()


@pytest.fixture(autouse=True)
def offer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the example as its package would."""
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    module = ModuleType("my_policies")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(program, vars(module))  # noqa: S102 - our own page
    ((name, where),) = re.findall(rf'entry-points."{POLICIES.group}"\]\n(\w+) = "(\S+)"', PAGE)
    monkeypatch.setitem(vars(POLICIES), "_offered", {name: EntryPoint(name, where, POLICIES.group)})


class TestTheExample(PolicySuite):
    @pytest.fixture
    def policy(self) -> Policy:
        return build("ahead?skills=4")


def test_the_table_names_every_parameter() -> None:
    rows = re.findall(r"^\| ([a-z0-9, -]+) \| `(\w+)` \|", PAGE, re.MULTILINE)
    documented = {(name, parameter) for names, parameter in rows for name in names.split(", ")}
    names = ("stream-to-act", "stream-to-act-early", "s2a-mean")
    early = {("stream-to-act-early", parameter) for parameter in ("spend", "within", "start_caution")}
    both = {(name, parameter) for name in names for parameter in ("caution", "detect")}
    assert documented == both | early
    for names, parameter, default in re.findall(r"^\| ([a-z0-9, -]+) \| `(\w+)` \| ([\w, ]+) \|", PAGE, re.MULTILINE):
        for place, name in enumerate(named := names.split(", ")):
            each = default.split(", ")[place if len(named) == default.count(", ") + 1 else 0]
            assert list(policies([f"{name}?{parameter}={each}"])) == [name]
    written = {"detect": "True", "spend": "0.7"}
    for name, parameter in documented:
        text = f"{name}?{parameter}={written.get(parameter, '7')}"
        assert list(policies([text])) == [text]
