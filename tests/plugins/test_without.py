"""Without a plug-in, and without any, everything else works, and its names are the usual line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest


class Named(NamedTuple):
    """One name that a plug-in brings: how it is used, what the error says without it, where help shows it."""

    use: tuple[str, ...]
    error: str
    help: tuple[str, ...]
    shown: str


PLUGINS = {
    "carla": [
        Named(
            ("ccrb", "--simulator", "carla"),
            "--simulator: 'carla' is none of ",
            ("ccrb", "--help-all"),
            "longitudinal, embedded, carla",
        )
    ],
    "chunks": [
        Named(("chunks",), "No such command 'chunks'", ("--help",), "chunks "),
        Named(
            ("timeline", "--live", "--robot", "plant"), "'plant' is none of timed, ros, call", ("--help",), "capacity "
        ),
    ],
    "rclpy": [
        Named(
            ("latency", "--middleware", "rclpy"),
            "--middleware: 'rclpy' is none of ",
            ("latency", "--help-all"),
            "rclpy",
        )
    ],
}
HIDING = """
import importlib.metadata as metadata
found = metadata.entry_points
hidden = {hidden!r}
metadata.entry_points = lambda **by: [point for point in found(**by) if not point.value.startswith(hidden)]
"""


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [*((name,) for name in PLUGINS), tuple(PLUGINS)], ids=", ".join)
def test_without_plug_ins_everything_else_works(hidden: tuple[str, ...], tmp_path: Path) -> None:
    modules = tuple(f"s2a_bench.plugins.{name}{end}" for name in hidden for end in ".:")
    (tmp_path / "sitecustomize.py").write_text(HIDING.format(hidden=modules))
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

    for plugin, names in PLUGINS.items():
        for name in names:
            assert (name.shown in run(*name.help)) == (plugin not in hidden)
            if plugin in hidden:
                assert name.error in run(*name.use, code=2)
    assert "loopback" in run("latency", "--quick", "--transport", "loopback", "--engine", "echo")
    assert "no impact" in run("ccrb")
    if len(hidden) == len(PLUGINS):
        assert "middleware" in run("doctor")
