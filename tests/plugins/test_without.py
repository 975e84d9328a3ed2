"""Without a plug-in, and without any, everything else works, and its name is the usual line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PLUGINS = {"carla": ("ccrb", "--simulator"), "rclpy": ("latency", "--middleware")}
"""Where each name is written."""
HIDING = """
import importlib.metadata as metadata
found = metadata.entry_points
hidden = {hidden!r}
metadata.entry_points = lambda **by: [
    point for point in found(**by) if not point.value.startswith("s2a_bench.plugins.") or point.name not in hidden
]
"""


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [("carla",), ("rclpy",), tuple(PLUGINS)], ids=", ".join)
def test_without_plug_ins_everything_else_works(hidden: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(HIDING.format(hidden=hidden))
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH", ""))))

    def run(*arguments: str, code: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "s2a_bench", *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stderr
        return done.stdout + done.stderr

    for name, (command, flag) in PLUGINS.items():
        about = run(command, "--help-all").split(f"{flag} ", 1)[1].split("\n  --", 1)[0]
        assert (name in about) == (name not in hidden)
    for name in hidden:
        command, flag = PLUGINS[name]
        assert f"{flag}: '{name}' is none of " in run(command, flag, name, code=2)
    assert "loopback" in run("latency", "--quick", "--transport", "loopback", "--engine", "echo")
    assert "no impact" in run("ccrb")
    if len(hidden) == len(PLUGINS):
        assert "middleware" in run("doctor")
