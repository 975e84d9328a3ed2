"""What pip installs: sdist and wheel have the files that they should, and work in fresh environments."""

from __future__ import annotations

import json
import sys
import tarfile
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

import s2a_bench
from s2a_bench.toml_file import loads
from tests.fresh import ROOT, copy_checkout, environment, pip, pythons, run, tracked

pytestmark = pytest.mark.slow
FOR_COLCON = {"COLCON_IGNORE"}
LINKED = {"s2a_bench/profiles/": "profiles/", "s2a_bench/ros/s2a_msgs/": "s2a_msgs/"}
"""Folders of the package that are links -> where their files are in the checkout."""
COMMANDS = (
    ("timeline", "--data-only"),
    ("latency", "--engine", "echo", "--requests", "5", "--transport", "loopback", "--data-only"),
)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the sdist of a copy of this checkout, and the wheel that is built from the sdist."""
    folder = tmp_path_factory.mktemp("built")
    builder = environment(sys.executable, folder / "builder")
    project = loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"), "pyproject.toml")
    pip(builder, "install", "--quiet", "--no-compile", *project["build-system"]["requires"], cwd=folder)
    source = copy_checkout(folder / "source")
    run(builder, "-c", "import setuptools.build_meta as b; b.build_sdist('../dist')", cwd=source)
    (sdist,) = (folder / "dist").glob("*.tar.gz")
    pip(builder, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, sdist, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return sdist, wheel


def packaged() -> set[str]:
    """Return the files that a wheel should have: those of the package, and those that it links to."""
    files = {name for name in tracked() if name.startswith("s2a_bench/") and not (ROOT / name).is_symlink()}
    for inside, at in LINKED.items():
        linked = (path.relative_to(ROOT / at) for path in (ROOT / at).glob("*/*") if path.is_file())
        files |= {f"{inside}{path}" for path in linked}
    files |= {f"s2a_bench/profiles/{path.name}" for path in (ROOT / "profiles").glob("*.toml")}
    return {name for name in files if Path(name).name not in FOR_COLCON}


def test_the_wheel_has_every_file_of_the_package_and_nothing_else(built: tuple[Path, Path]) -> None:
    files = {name for name in zipfile.ZipFile(built[1]).namelist() if ".dist-info/" not in name}
    assert files == packaged()
    suffixes = ".action .css .html .js .msg .py .pyi .srv .toml .typed"
    assert {Path(name).suffix for name in files} == {*suffixes.split()}


def test_the_sdist_has_what_the_wheel_is_made_of_and_the_pins(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        files = {name.partition("/")[2] for name in archive.getnames() if not archive.getmember(name).isdir()}
    beside = {name for name in files if not name.startswith(("s2a_bench/", "s2a_bench.egg-info/"))}
    assert packaged() <= files
    assert beside == {
        *("CHANGELOG.md", "LICENSE", "MANIFEST.in", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg"),
        *(path.name for path in ROOT.glob("constraints*.txt")),
    }


@pytest.mark.parametrize("place", [0, -1], ids=["oldest", "newest"])
def test_wheel_and_sdist_work_in_a_fresh_environment(place: int, built: tuple[Path, Path]) -> None:
    every = pythons()
    if not every or (place and len(every) == 1):
        pytest.skip("no other supported Python is installed")
    sdist, wheel = built
    install = ("install", "--quiet", "--no-compile")
    with TemporaryDirectory(prefix="s2a-fresh-") as folder:  # 700 MB, so that it is not kept
        at = Path(folder)
        python = environment(every[place], at / "venv")
        pip(python, *install, "-c", ROOT / "constraints.txt", wheel, cwd=at)
        works(python, at / "wheel")
        pip(python, *install, "--no-deps", "--force-reinstall", sdist, cwd=at)
        works(python, at / "sdist")
        where = run(python, "-c", "import s2a_bench; print(s2a_bench.__file__)", cwd=at)
        assert where.startswith(str(at / "venv"))


def works(python: Path, folder: Path) -> None:
    """Run the program in a folder of its own: its version, and two runs."""
    folder.mkdir()
    program = python.parent / "s2a-bench"
    assert run(program, "--version", cwd=folder) == f"{s2a_bench.__version__}\n"
    for command in COMMANDS:
        whole = json.loads(run(program, *command, "--json", cwd=folder))
        assert whole["command"] == command[0]
    commands = (json.loads(path.read_text())["command"] for path in folder.glob("results/*/manifest.json"))
    assert sorted(commands) == ["latency", "timeline"]
