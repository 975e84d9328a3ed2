"""Transports are named where they are, and in the few places of the core that are about one of them."""

from __future__ import annotations

import re
from pathlib import Path

import s2a_bench

HERE = Path(s2a_bench.__file__).parent
NAMED = re.compile(r'"(http|ros|loopback|shm)["/]')
ALLOWED = {
    "act/__init__.py": (1, "the robot behind ROS"),
    "act/ros.py": (1, "its name"),
    "frames/__init__.py": (1, "the camera behind ROS"),
    "machine/environment.py": (1, "the key of the ROS variables in a manifest"),
    "scenario/ros.py": (1, "the name of an ego behind ROS"),
}
"""File -> lines, and why."""


def test_no_other_module_names_a_transport() -> None:
    found = {
        name: sum(bool(NAMED.search(line)) for line in path.read_text("utf-8").splitlines())
        for path in sorted(HERE.rglob("*.py"))
        if not (name := path.relative_to(HERE).as_posix()).startswith(("transport/", "ros/", "plugins/"))
    }
    assert {name: count for name, count in found.items() if count} == {name: n for name, (n, _) in ALLOWED.items()}
    assert sum(count for count, _ in ALLOWED.values()) <= 10
