"""What docs/colcon.md and docs/rclpy.md say is what the scripts of tests/recipes do, which want a ROS 2."""

from __future__ import annotations

import ast
import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "tests" / "recipes"
AS_IN_DOCS = ((r"\$ROS_DISTRO|\$\{ROS_DISTRO:-jazzy\}", "jazzy"), (r"\$\{S2A_EXTRAS:-llama\}", "llama"), (r"[\"']", ""))
"""What a script leaves open, and quotes."""
ELSEWHERE = ("mkdir -p ~/ws/src", "cd ~/ws", "git clone", "ros2 launch")


def commands(text: str) -> list[str]:
    """The commands of a page's indented blocks, or of a script, one each."""
    for pattern, instead in AS_IN_DOCS:
        text = re.sub(pattern, instead, text)
    lines = [line.split("  #")[0].strip() for line in text.splitlines()]
    return [part.strip() for line in lines for part in line.split("&&")]


def test_the_script_in_python_is_one_for_the_oldest_python() -> None:
    ast.parse((RECIPES / "rclpy_speed").read_text(), feature_version=(3, 10))


@pytest.mark.parametrize("name", ["colcon", "rclpy"])
def test_the_page_says_what_the_script_does(name: str) -> None:
    page = (ROOT / "docs" / f"{name}.md").read_text()
    blocks = "\n".join(line for line in page.splitlines() if line.startswith("    "))
    said = [line for line in commands(blocks) if not line.startswith(ELSEWHERE)]
    done = commands((RECIPES / name).read_text())
    assert len(said) > 3
    assert [line for line in said if line not in done] == []


@pytest.mark.parametrize("name", ["colcon", "rclpy"])
def test_without_ros_one_line_says_so(name: str, tmp_path: Path) -> None:
    environ = os.environ | {"ROS_DISTRO": "nowhere"}
    command = ["bash", str(RECIPES / name), str(tmp_path / "ws")]
    done = subprocess.run(command, capture_output=True, text=True, env=environ, check=False)
    assert done.returncode == 1
    assert done.stderr == "no ROS 2 nowhere in /opt/ros: install it, or set ROS_DISTRO\n"
    assert not (tmp_path / "ws").exists()
