"""Without half of the plug-ins, either half, and without any, everything else works; their names are the usual line."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path
from typing import NamedTuple

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


class Named(NamedTuple):
    """One name that a plug-in brings: how it is used, what the error says without it, where help shows it."""

    use: str
    error: str
    help: str
    shown: str


PLUGINS = {
    "carla": [
        Named(
            "ccrb --simulator carla",
            "--simulator: 'carla' is not one of ",
            "ccrb --help-all",
            "longitudinal, embedded, carla",
        )
    ],
    "two_hosts": [
        Named("latency --link 4g", "No such option: --link", "latency --help-all", "--link "),
        Named("latency --clock ptp", "No such option: --clock", "latency --help-all", "--clock "),
        Named("advise --link 4g", "No such command 'advise'", "--help", "advise  "),
        Named("sweep links", "'links' is not one of ", "sweep --help", "links"),
    ],
    "policy_servers": [
        Named(
            "latency --transport websocket",
            "--transport: 'websocket' is not one of ",
            "latency --help-all",
            "loopback, websocket, zmq, grpc",
        ),
        Named(
            "latency --url http://127.0.0.1:9 --dialect openvla",
            "--dialect: 'openvla' is not one of ",
            "latency --help-all",
            "--template",
        ),
    ],
    "paper": [
        Named("report results --against paper", "--against: 'paper' should be left out", "report --help", "paper: add")
    ],
    "chunks": [
        Named("chunks", "No such command 'chunks'", "--help", "chunks "),
        Named("capacity", "No such command 'capacity'", "--help", "capacity "),
        Named("task", "No such command 'task'", "--help", "task "),
    ],
    "watch": [Named("watch", "No such command 'watch'", "--help", "watch ")],
    "rclpy": [Named("latency --middleware rclpy", "--middleware: 'rclpy' is not one", "latency --help-all", "rclpy")],
    "zenoh": [
        Named("latency --middleware zenoh", "--middleware: 'zenoh' is not one of ", "latency --help-all", "zenoh"),
        Named("latency --router tcp/127.0.0.1:7447", "No such option: --router", "latency --help-all", "--router"),
    ],
}

NAMES = tuple(PLUGINS)

HIDING = """
import importlib.metadata as metadata
hidden = {hidden!r}
points = [point for each in metadata.distributions() for point in each.entry_points]
kept = metadata.EntryPoints(point for point in points if not point.value.startswith(hidden))
metadata.entry_points = lambda **by: kept.select(**by)
"""
LIBRARY = """
import s2a_bench as s2a
run = s2a.timeline(policy="naive,wait-then-act", output="library")
print(len(run.table("timelines")), s2a.__name__, not s2a.compare(run, run).table().empty)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the package offline, as a wheel, into a folder of its own, which is returned."""
    pytest.importorskip("setuptools", reason="builds the package")
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in ("s2a_bench", "profiles", "s2a_msgs"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(target), str(source)], check=True, timeout=300)
    return target


@pytest.mark.parametrize("hidden", [NAMES[::2], NAMES[1::2], NAMES], ids=", ".join)
def test_without_plug_ins_everything_else_works(hidden: tuple[str, ...], wheel: Path, tmp_path: Path) -> None:
    modules = tuple(f"s2a_bench.plugins.{name}{end}" for name in hidden for end in ".:")
    (tmp_path / "sitecustomize.py").write_text(HIDING.format(hidden=modules))
    kept = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    path = os.pathsep.join([str(tmp_path), str(wheel), *(each for each in kept if each != str(ROOT))])
    started = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}, "text": True}

    def python(*arguments: str, code: int = 0) -> str:
        done = subprocess.run([sys.executable, *arguments], capture_output=True, check=False, **started)
        assert done.returncode == code, done.stderr
        return done.stdout + done.stderr

    def run(*arguments: str, code: int = 0) -> str:
        return python("-m", "s2a_bench", *arguments, code=code)

    assert str(wheel) in python("-c", "import s2a_bench; print(s2a_bench.__file__)")
    helps = {line: run(*line.split()) for line in {name.help for names in PLUGINS.values() for name in names}}
    for plugin, names in PLUGINS.items():
        for name in names:
            assert (name.shown in helps[name.help]) == (plugin not in hidden)
            if plugin in hidden:
                assert name.error in run(*name.use.split(), code=2)
    assert "loopback" in run("latency", "--quick", "--transport", "http,ros,loopback", "--engine", "echo")
    assert "no impact" in run("ccrb")
    assert "s2a_bench True" in python("-c", LIBRARY)
    run("report", *map(str, (tmp_path / "results").iterdir()), "--output", "page.html")
    assert "no impact" in (tmp_path / "page.html").read_text()
    if len(hidden) < len(PLUGINS):
        return
    assert "tokens/s" in run("throughput", "--quick", "--engine", "replay", "--profile", "rtx-4080")
    assert "naive" in run("timeline")
    assert "8 of 8 cells finished" in run("sweep", "quick", "--output", "swept")
    assert "middleware" in run("doctor")
    line = [sys.executable, "-m", "s2a_bench", "serve", "http?port=0", "--engine", "echo"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, **started) as server:
        assert "http://127.0.0.1:" in server.stdout.readline()
        server.send_signal(signal.SIGINT)


MODULES = sorted({point.module for point in distribution("s2a-bench").entry_points} - {"s2a_bench.cli"})
OPTIONS = """
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.references import AgainstReference
from s2a_bench.options import places
print(*places(LatencyConfig), AgainstReference.model_fields["against"].description)
"""


@pytest.mark.parametrize("module", MODULES)
def test_a_plug_in_may_be_imported_before_what_it_adds_options_to(module: str) -> None:
    code = f"import {module}{OPTIONS}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"link", "clock", "router", "template", "paper:"} <= {*done.stdout.split()}
