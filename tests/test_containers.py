"""The Dockerfiles, which no builder was there to build: linted, and their commands run or parsed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest

import s2a_bench
from tests.fresh import ALONE, ROOT, copy_checkout, environment, pip, pythons, run

BASE, ROS = ROOT / "Dockerfile", ROOT / "docker" / "ros-jazzy.Dockerfile"
BOTH = pytest.mark.parametrize("path", [BASE, ROS], ids=["base", "ros-jazzy"])


class Step(NamedTuple):
    """One instruction of a Dockerfile, its lines joined."""

    instruction: str
    text: str


def steps(path: Path) -> list[Step]:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [Step(*line.split(maxsplit=1)) for line in joined.splitlines() if line.strip()]


def texts(path: Path, instruction: str) -> list[str]:
    return [step.text for step in steps(path) if step.instruction == instruction]


def context() -> list[str]:
    """Return the files and folders at the top that .dockerignore lets into an image."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert lines[1] == "*"
    return [line.removeprefix("!") for line in lines if line.startswith("!")]


@BOTH
def test_hadolint_has_nothing_to_say(path: Path) -> None:
    beside = Path(sys.executable).parent / "hadolint"
    hadolint = str(beside) if beside.exists() else shutil.which("hadolint")
    if not hadolint:
        pytest.skip("hadolint is not installed")
    done = subprocess.run([hadolint, "--no-color", str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@BOTH
def test_an_image_runs_the_program_without_root_and_keeps_dds_inside(path: Path) -> None:
    assert int(texts(path, "USER")[-1]) >= 1000
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST" in " ".join(texts(path, "ENV"))
    assert "s2a-bench" in texts(path, "ENTRYPOINT")[-1] + texts(path, "RUN")[-1]


@BOTH
def test_what_is_copied_is_in_the_checkout_and_in_the_context(path: Path) -> None:
    assert all((ROOT / name).exists() for name in context())
    named = [text.split()[0] for text in texts(path, "COPY") if not text.startswith("--from")]
    assert {*named} - {"."} <= {*context()}
    pins = re.findall(r"constraints[\w-]*\.txt", " ".join(texts(path, "RUN")))
    assert pins
    assert {*pins} <= {*context()}


@BOTH
def test_the_commands_are_valid_for_the_shell(path: Path) -> None:
    for text in texts(path, "RUN"):
        done = subprocess.run(["bash", "-n"], input=text, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), text


def test_the_image_of_ros_is_made_by_the_commands_of_the_page() -> None:
    page = (ROOT / "docs" / "colcon.md").read_text(encoding="utf-8").replace("'", "").replace("[llama]", "")
    done = " && ".join(texts(ROS, "RUN")).replace("--no-cache-dir ", "")
    recipe = (
        "python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE && . venv/bin/activate",
        "pip install -c src/s2a-bench/constraints-ros-jazzy.txt src/s2a-bench && pip uninstall -y s2a-bench",
        "rosdep install --from-paths src --ignore-src -y",
        "source /opt/ros/jazzy/setup.bash",
        "python -m colcon build",
    )
    for command in recipe:
        assert command in page, command
        assert command in done, command


@pytest.fixture
def image() -> Iterator[Path]:
    """A folder in place of the image's root; 700 MB, so that it is not kept."""
    with TemporaryDirectory(prefix="s2a-image-") as folder:
        yield Path(folder)


@pytest.mark.slow
def test_the_pip_commands_of_the_base_image_install_the_program(image: Path) -> None:
    (version,) = {text.partition(":")[2].partition("-")[0] for text in texts(BASE, "FROM")}
    same = [path for path in pythons() if run(path, "--version", cwd=image).startswith(f"Python {version}.")]
    python = environment(same[0] if same else sys.executable, image / "venv")
    pip(python, "install", "--quiet", "--no-compile", "pip", cwd=image)
    source = copy_checkout(image / "src", *context())
    (image / "wheels").mkdir()
    shutil.copy(source / "constraints.txt", image / "wheels")
    commands = [text for text in texts(BASE, "RUN") if text.startswith("pip ")]
    assert len(commands) == 2
    for text in commands:
        command = re.sub(r"(?<![\w.])/wheels\b", str(image / "wheels"), text).replace(" --no-cache-dir", "")
        in_image = {"PATH": f"{python.parent}:{ALONE['PATH']}", "PIP_NO_COMPILE": "1"}
        run("sh", "-c", command, cwd=source, **in_image)
    assert run(python.parent / "s2a-bench", "--version", cwd=image) == f"{s2a_bench.__version__}\n"
    first = ("latency", "--engine", "echo", "--requests", "2", "--transport", "ros,loopback", "--payload", "raw")
    assert "ros/topic" in run(python.parent / "s2a-bench", *first, "--data-only", cwd=image)
