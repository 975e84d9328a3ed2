"""Hostile and honest clients together for less than a minute: `python -m benchmarks.soak` has no such limit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.hostile.asking import usage

from benchmarks.soak import HOSTILE, served, wiring

MINUTES = float(os.environ.get("S2A_SOAK_MINUTES", "0.5"))
KEPT_MIB = 100.0
Soaks = dict[str, Path]


def test_bodies_that_no_framework_lets_go_are_not_kept(tmp_path: Path) -> None:
    """FastAPI's errors hold the body, in cycles that Python looks for when it likes; grown blocks stay in the heap."""
    (big,) = (case for case in HOSTILE["http"] if case.name == "64 MiB of spaces")
    with served("http", "echo", "big", tmp_path / "log") as server:
        before = usage(server.process.pid)
        for _ in range(8):
            big.does(wiring("http", server.address))
        deadline = time.monotonic() + 30
        while usage(server.process.pid).rss_mib > before.rss_mib + KEPT_MIB and time.monotonic() < deadline:
            time.sleep(0.2)
        assert usage(server.process.pid).rss_mib < before.rss_mib + KEPT_MIB


@pytest.fixture(scope="module")
def came(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Soaks:
    """What came of the soaks of all tests that were chosen, which happen at once, each in a process of its own.

    A soak that broke off left no file: its test fails, and shows its output.
    """
    specs = [item.callspec.params for item in request.session.items if hasattr(item, "callspec")]
    folder = tmp_path_factory.mktemp("soaks")
    paths = {name: folder / f"{name.replace('/', '-')}.json" for name in HOSTILE if {"soaked": name} in specs}
    with ExitStack() as stack:
        for name, path in paths.items():
            line = [sys.executable, "-m", "benchmarks.soak", name, "--minutes", str(MINUTES), "--blocks", "5"]
            log = stack.enter_context(path.with_suffix(".log").open("w"))
            process = subprocess.Popen([*line, "--output", str(path)], stdout=log, stderr=log)
            stack.callback(process.wait)
    return paths


@pytest.mark.parametrize("soaked", [*HOSTILE])
def test_no_promise_is_broken_within_a_minute(soaked: str, came: Soaks) -> None:
    """But for the idle latency, which tells of whatever else the machine does; growth takes longer to be judged."""
    path = came[soaked]
    assert path.exists(), path.with_suffix(".log").read_text()[-3000:]
    whole = json.loads(path.read_text())
    assert [line for line in whole["broken"] if not line.startswith(("the idle latency", "the memory"))] == []
    assert whole["growth_mib"] < KEPT_MIB
