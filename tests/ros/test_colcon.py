"""The tree builds in a ROS 2 workspace, as far as that shows without ROS."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from xml.etree import ElementTree as ET

import pytest

from s2a_bench import __version__

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"s2a_bench": ROOT / "colcon", "s2a_msgs": ROOT / "s2a_msgs"}
BESIDE = Path(sys.executable).with_name("colcon")
COLCON = str(BESIDE) if BESIDE.exists() else shutil.which("colcon")
needs_colcon = pytest.mark.skipif(COLCON is None, reason="colcon is not installed: pip install -e .[dev]")


def colcon(folder: Path, *arguments: str) -> str:
    command = [str(COLCON), "--log-base", str(folder / "log"), *arguments]
    environ = os.environ | {"COLCON_HOME": str(folder / "home")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environ, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def manifest(package: str) -> ET.Element:
    return ET.parse(PACKAGES[package] / "package.xml").getroot()  # noqa: S314 - our own file


@pytest.mark.parametrize("package", list(PACKAGES))
def test_manifests_carry_our_name_version_and_licence(package: str) -> None:
    root = manifest(package)
    assert root.get("format") == "3"
    assert [root.findtext(tag) for tag in ("name", "version", "license")] == [package, __version__, "Apache-2.0"]


def test_the_interface_package_generates_every_message() -> None:
    listed = re.findall(r'"((?:action|msg)/\w+\.\w+)"', (PACKAGES["s2a_msgs"] / "CMakeLists.txt").read_text())
    folder = PACKAGES["s2a_msgs"]
    assert listed == sorted(str(path.relative_to(folder)) for path in folder.glob("*/*"))


@needs_colcon
def test_a_workspace_with_our_tree_has_two_packages(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "s2a-bench").symlink_to(ROOT)
    assert colcon(tmp_path, "list").splitlines() == [
        "s2a_bench\tsrc/s2a-bench/colcon\t(ros.ament_python)",
        "s2a_msgs\tsrc/s2a-bench/s2a_msgs\t(ros.ament_cmake)",
    ]
    order = colcon(tmp_path, "list", "--topological-order", "--names-only").split()
    assert order == ["s2a_msgs", "s2a_bench"]


@needs_colcon
@pytest.mark.slow
@pytest.mark.parametrize("flags", [[], ["--symlink-install"]])
def test_ros2_run_finds_the_program_and_it_has_its_files(tmp_path: Path, flags: list[str]) -> None:
    colcon(tmp_path, "build", "--base-paths", str(PACKAGES["s2a_bench"]), *flags)
    prefix = tmp_path / "install" / "s2a_bench"
    assert (prefix / "share/ament_index/resource_index/packages/s2a_bench").is_file()
    assert (prefix / "share/s2a_bench/launch/s2a_bench.launch.py").is_file()
    assert (prefix / "share/s2a_bench/package.xml").is_file()
    script = f"""
        . install/local_setup.sh
        install/s2a_bench/lib/s2a_bench/s2a-bench --version || exit 1
        {sys.executable} -c "import s2a_bench; print(s2a_bench.__file__)"
        install/s2a_bench/lib/s2a_bench/s2a-bench doctor --json
    """
    # the program takes the first Python on PATH, as in a virtual environment
    environ = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    command = ["sh", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environ, check=False)
    assert done.returncode == 0, done.stderr
    version, where, *examined = done.stdout.splitlines()
    assert version == __version__
    findings = {each["code"]: each for each in json.loads("\n".join(examined))["checks"]}
    assert re.match(r"\d\d requirements, all met", findings["packages"]["message"]), findings["packages"]
    installed = Path(where).parent
    assert installed.is_relative_to(tmp_path)
    package = ROOT / "s2a_bench"
    files = [path for path in package.glob("**/*.*") if path.is_file() and path.suffix != ".pyc"]
    names = [str(path.relative_to(package)) for path in files]
    names += [f"ros/s2a_msgs/{path.relative_to(ROOT / 's2a_msgs')}" for path in (ROOT / "s2a_msgs").glob("*/*")]
    assert [name for name in names if not (installed / name).is_file()] == []


def test_the_launch_file_starts_a_camera_and_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {name: Mock() for name in ("launch", "launch_ros")}
    for name in ("actions", "conditions", "substitutions"):
        for module, mock in made.items():
            monkeypatch.setitem(sys.modules, module, mock)
            monkeypatch.setitem(sys.modules, f"{module}.{name}", getattr(mock, name))
    made["launch"].substitutions.LaunchConfiguration = "<{}>".format
    made["launch"].substitutions.PythonExpression = "".join
    made["launch"].conditions.IfCondition = str
    made["launch_ros"].substitutions.ExecutableInPackage = lambda *of: " of ".join(of)
    scope: dict[str, Any] = {}
    path = PACKAGES["s2a_bench"] / "launch" / "s2a_bench.launch.py"
    exec(compile(path.read_text(), str(path), "exec"), scope)  # noqa: S102 - as ros2 launch does
    scope["generate_launch_description"]()
    cameras = [call.kwargs for call in made["launch_ros"].actions.Node.call_args_list]
    assert [(each["package"], each["condition"], each["remappings"]) for each in cameras] == [
        ("v4l2_camera", "'<camera>' == 'v4l2'", [("image_raw", ["<namespace>", "/camera/image_raw"])]),
        ("image_tools", "'<camera>' == 'test'", [("image", ["<namespace>", "/camera/image_raw"])]),
    ]
    ((command,),) = (made["launch"].actions.ExecuteProcess.call_args.kwargs["cmd"],)
    assert "".join(command) == (
        "exec s2a-bench of s2a_bench serve ros --namespace <namespace> --node-name <node_name> --engine <engine> "
        "<arguments> '--ros-args --params-file \"<params_file>\"' if '<params_file>' else ''"
    )
    depends = {each.text for each in manifest("s2a_bench").iter("exec_depend")}
    assert {each["package"] for each in cameras} | {"launch", "launch_ros"} <= depends
