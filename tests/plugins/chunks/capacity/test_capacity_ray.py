"""Fleets of robots on a local two-node Ray cluster: measured, checked on each node, and lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.plugins.chunks.capacity.rows import FLEETS, ROBOTS
from s2a_bench.store.run import StoredRun, read_run
from tests.cli.program import program
from tests.cli.test_provenance import serving

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # what Ray warns of is Ray's

WAIT_S = 120
FLEET = (
    *("capacity", "--transport", "websocket/openpi", "--size", "64x48", "--modes", "sync", "--limit", ""),
    *("--control-hz", "2", "--horizon", "2", "--processes", "2", "--robots", "3", "--settle", "0", "--looks", "1"),
)
"""Ticks of half a second are in time on a machine under load."""


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """A server whose chunks take 100 ms."""
    options = ("--engine", "echo", "--answer", "actions", "--horizon", "2", "--latency", "100", "--port", "0")
    with serving("websocket", *options) as line:
        yield line.split("at ")[1].split(",")[0]


def only(folder: Path) -> StoredRun:
    (found,) = folder.iterdir()
    return read_run(found)


def test_robots_on_two_nodes_are_served_by_one_server_and_checked_against_their_own(
    cluster: Any, url: str, tmp_path: Path
) -> None:
    program(*FLEET, "--url", url, "--ray", cluster.address, "--seconds", "4", "--output", tmp_path)
    run = only(tmp_path)
    fleets, robots = run.table(FLEETS), run.table(ROBOTS)
    assert fleets.groupby("source")["robots"].apply(list).to_dict() == {
        "measured": [1, 3],
        "predicted": [1, 3],
        "twin": [3],
    }
    assert sorted(robots[(robots["robots"] == 3) & (robots["source"] == "measured")]["robot"]) == [0, 1, 2]
    latency_ns = fleets.set_index("source")["latency_p50_ns"]
    assert (latency_ns["measured"] >= 100_000_000).all()
    assert latency_ns["twin"] < 100_000_000
    assert run.manifest["machines"].keys() == {run.manifest["environment"]["host"]}


def test_a_lost_process_ends_the_run_in_one_line_and_what_was_measured_stays(
    cluster: Any, url: str, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "s2a_bench", *FLEET, "--url", url, "--ray", cluster.address]
    command += ["--seconds", "60", "--output", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + WAIT_S
    while not (workers := actors()) or not list(tmp_path.glob("*/samples.csv")):
        assert time.monotonic() < until
        assert process.poll() is None, process.communicate()
        time.sleep(0.2)
    os.kill(workers[0], signal.SIGKILL)
    _, err = process.communicate(timeout=WAIT_S)
    (line,) = (line for line in err.splitlines() if line.startswith("error: "))
    assert "a process of robots on Ray died" in line
    assert "Traceback" not in err
    assert only(tmp_path).manifest["state"] == "failed"


def actors() -> list[int]:
    """Return the processes of fleets on Ray."""
    found = subprocess.run(["pgrep", "-f", "ray::Fleet"], capture_output=True, text=True, check=False)
    return [int(each) for each in found.stdout.split()]


def test_an_address_without_ray_is_one_line(url: str, tmp_path: Path) -> None:
    done = program(*FLEET, "--url", url, "--ray", "127.0.0.1:1", "--output", tmp_path / "out", code=2)
    assert "--ray: no Ray cluster answers at 127.0.0.1:1" in done.stderr
    assert not (tmp_path / "out").exists()
