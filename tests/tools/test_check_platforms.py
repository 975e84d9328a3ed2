"""The platform check's own parts, without an index: markers, pins, reports, and what it says when none answers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
SCRIPT = ROOT / "tools" / "check_platforms.py"
sys.path.insert(0, str(SCRIPT.parent))

import check_platforms as check  # noqa: E402

EVERYWHERE = [target for target in check.TARGETS if target.constraints == check.CONSTRAINTS]
INSIDE_ROS = [target for target in check.TARGETS if target not in EVERYWHERE]
BY_NAME = {(target.python, target.machine): target for target in EVERYWHERE}
JETPACK, JAZZY = BY_NAME["3.10", "aarch64"], BY_NAME["3.12", "x86_64"]


def test_pins_follow_their_markers() -> None:
    text = (
        "# comment\n\nnumpy==2.4.6; python_version >= '3.11'\nnumpy==2.2.6; python_version < '3.11'\nRuamel_YAML==1\n"
    )
    assert check.pins(JETPACK, text) == {"numpy": "2.2.6", "ruamel-yaml": "1"}
    assert check.pins(JAZZY, text)["numpy"] == "2.4.6"


def test_a_package_without_a_pin_or_with_another_version_is_told() -> None:
    report = {"install": [{"metadata": {"name": name, "version": "2"}} for name in ("Numpy", "six", "rich")]}
    assert check.unpinned(JAZZY, report, "numpy==2\nsix==1\n") == [
        "rich==2 is not pinned here: add it to constraints.txt",
        "six==2 is not pinned here: add it to constraints.txt",
    ]


def test_no_pin_is_given_twice_for_one_platform() -> None:
    for target in check.TARGETS:
        lines = [check.Requirement(line) for line in target.pinned().splitlines() if line and not line.startswith("#")]
        mine = [pin.name for pin in lines if not pin.marker or pin.marker.evaluate(target.markers())]
        assert len(mine) == len(set(mine))


@pytest.mark.parametrize("target", INSIDE_ROS, ids=str)
def test_beside_ros_numpy_is_1_and_all_that_is_needed_is_pinned(target: check.Target) -> None:
    pinned = check.pins(target, target.pinned())
    assert pinned["numpy"].startswith("1.")
    assert int(pinned["pyarrow"].split(".")[0]) < 26, "pyarrow 26 loads beside NumPy 2 only, without saying so"
    for wanted in map(check.Requirement, check.requirements(target)):
        assert wanted.specifier.contains(pinned[check.canonicalize_name(wanted.name)]), wanted


def test_wheels_of_every_older_system_are_taken() -> None:
    flags = " ".join(JETPACK.wheels())
    assert "--platform manylinux_2_35_aarch64" in flags
    assert "--platform manylinux_2_17_aarch64" in flags
    assert "x86_64" not in flags
    assert "manylinux_2_36" not in flags


@pytest.mark.parametrize("target", [JETPACK, JAZZY], ids=str)
def test_this_pip_takes_the_targets_markers(target: check.Target) -> None:
    command = [sys.executable, "-c", check.AS_TARGET, json.dumps(target.markers()), "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("pip ")


@pytest.mark.parametrize(("flags", "code"), [([], 3), (["--offline-ok"], 0)])
def test_without_an_index_one_line_says_that_nothing_was_checked(flags: list[str], code: int) -> None:
    environ = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    environ |= {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": ""}
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *flags], capture_output=True, text=True, check=False, env=environ
    )
    assert done.returncode == code
    assert done.stdout == ""
    assert done.stderr == "check-platforms: no package index can be reached from here; nothing was checked\n"
