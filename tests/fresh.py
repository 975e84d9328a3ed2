"""Fresh environments: what a user has after `pip install`, made from a copy of this checkout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SUPPORTED = range(10, 14)
"""Minor versions of Python 3 that docs/install.md names."""
ALONE = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}}
"""The environment of a program that sees no checkout."""


def tracked() -> list[str]:
    """Return what git keeps or would keep of this checkout; skip the test where this is not a git checkout."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("this is no git checkout")
    return [name for name in listed.stdout.splitlines() if os.path.lexists(ROOT / name)]


def copy_checkout(to: Path, *tops: str) -> Path:
    """Copy the files of this checkout, links as links: all, or those in some files and folders at its top."""
    for name in tracked():
        if not tops or name.partition("/")[0] in tops:
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name, follow_symlinks=False)
    return to


def run(*command: str | Path, cwd: Path, **environ: str) -> str:
    """Run a program that succeeds, with additions to its environment, and return what it prints.

    Skip the test if it is pip and no package index answers.
    """
    done = subprocess.run(
        command, cwd=cwd, env=ALONE | environ, capture_output=True, text=True, check=False, timeout=600
    )
    if re.search("NewConnection|NameResolution|ConnectTimeout|ReadTimeout|ProxyError", done.stderr):
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def pip(python: Path, *arguments: str | Path, cwd: Path) -> None:
    """Run this environment's pip for another Python."""
    run(sys.executable, "-m", "pip", "--python", python, "--retries", "1", "--timeout", "30", *arguments, cwd=cwd)


def pythons() -> list[str]:
    """Return the supported Pythons of this machine, the oldest first: in PATH, or of pyenv."""
    return [path for minor in SUPPORTED if (path := _python(minor))]


def _python(minor: int) -> str:
    of_pyenv = sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python"))
    for path in (shutil.which(f"python3.{minor}"), *map(str, of_pyenv)):
        code = "import sys, venv; print(sys.version_info[1])"
        if (
            path
            and subprocess.run([path, "-c", code], capture_output=True, text=True, check=False).stdout == f"{minor}\n"
        ):
            return path
    return ""


def environment(python: str, at: Path) -> Path:
    """Make a virtual environment without pip, and return its Python."""
    run(python, "-m", "venv", "--without-pip", at, cwd=at.parent)
    return at / "bin" / "python"
