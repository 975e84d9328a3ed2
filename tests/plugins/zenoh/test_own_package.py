"""A copy of the plug-in's folder, in a package of its own that offers its entry points, takes its place.

Its tests are the plug-in's, with the module's name changed. What ships with s2a-bench cannot be imported meanwhile.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import defaultdict
from importlib.metadata import distribution
from pathlib import Path

import pytest

from tests.plugins.test_without import HIDING

pytest.importorskip("zenoh", reason="the extra zenoh is not installed")

ROOT = Path(__file__).parent.parent.parent.parent
SHIPPED, OWN = "s2a_bench.plugins.zenoh", "own_zenoh"
BARRED = f"import sys\nsys.modules[{SHIPPED!r}] = None\n"


def copy(folder: Path, to: Path) -> None:
    """Copy a folder's modules, except this one, as those of the package of its own."""
    to.mkdir()
    for path in folder.glob("*.py"):
        if path.name != Path(__file__).name:
            (to / path.name).write_text(path.read_text(encoding="utf-8").replace(SHIPPED, OWN), encoding="utf-8")


def describe(folder: Path) -> None:
    """Write the package's metadata, with the entry points that the plug-in has."""
    groups: dict[str, list[str]] = defaultdict(list)
    for point in distribution("s2a-bench").entry_points:
        if point.module.startswith(SHIPPED):
            groups[point.group].append(f"{point.name} = {point.value.replace(SHIPPED, OWN)}")
    metadata = folder / f"{OWN}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {OWN}\nVersion: 1.0\n")
    lines = [line for group, points in groups.items() for line in (f"[{group}]", *points)]
    (metadata / "entry_points.txt").write_text("\n".join(lines))


@pytest.mark.slow
def test_a_copy_in_another_folder_takes_its_place_and_passes_its_tests(tmp_path: Path) -> None:
    copy(ROOT / SHIPPED.replace(".", "/"), tmp_path / OWN)
    copy(Path(__file__).parent, tmp_path / "tests_of_own")
    describe(tmp_path)
    (tmp_path / "sitecustomize.py").write_text(BARRED + HIDING.format(hidden=(f"{SHIPPED}:",)))
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH", ""))))
    command = ["-m", "pytest", "-q", "-p", "tests.conftest", "-p", "no:cacheprovider", "-c", "pyproject.toml"]
    done = subprocess.run(
        [sys.executable, *command, str(tmp_path / "tests_of_own")],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"(\d+) passed", done.stdout)
    assert int(passed[1]) > 100
