"""A client and a server in two network namespaces, with two clocks, over a link whose directions differ."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from s2a_bench.store.run import read_run

HERE = Path(__file__).parent
OFFSET_NS, PPM = 5 * 10**9, 50
"""The server's clock: so far ahead, and so much faster."""
NAMESPACES = ("unshare", "-rn", "--pid", "--fork", "--mount-proc", "--kill-child")
"""Of users, networks and processes: all that runs in them ends with the shell."""
VETH = """
set -e
ip link set lo up
unshare -n sleep 900 > /dev/null 2>&1 &
peer=$!
until [ "$(readlink /proc/$peer/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.05; done
inside() { nsenter -t $peer -n "$@"; }
ip link add s2a-client type veth peer name s2a-server netns $peer
ip address add 10.99.0.1/24 dev s2a-client
ip link set s2a-client up
inside ip address add 10.99.0.2/24 dev s2a-server
inside ip link set s2a-server up
inside ip link set lo up
tc qdisc add dev s2a-client root tbf rate 20mbit burst 32kb latency 1s
inside tc qdisc add dev s2a-server root tbf rate 200mbit burst 32kb latency 1s
"""
"""Two namespaces and a link, 20 Mbit/s up and 200 down; they end with the shell."""
RUN = """
S2A_TEST_CLOCK="$CLOCK" PYTHONPATH="$ANOTHER_CLOCK:$PYTHONPATH" nsenter -t $peer -n \
    "$PYTHON" -m s2a_bench serve $SERVE --engine echo > server.log 2>&1 &
for _ in $(seq 600); do grep -q "^serving" server.log && break; sleep 0.1; done
"$PYTHON" -m s2a_bench latency $MEASURE --requests 8 --warmup 2 --output runs --sample-resources 0
"""


@cache
def why_not() -> str:
    """Return why this machine has no namespaces or no such link, or nothing."""
    command = [*NAMESPACES, "bash", "-c", VETH]
    try:
        tried = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return tried.stderr.strip() if tried.returncode else ""


def measured(folder: Path, serve: str, measure: str) -> Path:
    """Serve in one namespace and measure in the other; return the run folder."""
    if reason := why_not():
        pytest.skip(f"no two network namespaces here: {reason}")
    environment = {
        **os.environ,
        "SERVE": serve,
        "MEASURE": measure,
        "PYTHON": sys.executable,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "CLOCK": f"{OFFSET_NS} {PPM}",
        "ANOTHER_CLOCK": str(HERE / "another_clock"),
        "PYTHONPATH": os.pathsep.join((str(HERE.parents[2]), os.environ.get("PYTHONPATH", ""))),
        "S2A_TEST_MARKS": str(folder / "marks.jsonl"),
    }
    command = [*NAMESPACES, "bash", "-c", VETH + RUN]
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert not ran.returncode, f"{ran.stderr}\n{(folder / 'server.log').read_text()}"
    (run,) = (folder / "runs").iterdir()
    return run


@pytest.mark.parametrize(
    ("serve", "measure"),
    [
        ("http --host 10.99.0.2 --port 8080 --no-auth", "--url http://10.99.0.2:8080 --payload jpeg"),
        pytest.param(
            "websocket --host 10.99.0.2 --port 8000 --no-auth", "--url ws://10.99.0.2:8000", marks=pytest.mark.slow
        ),
        pytest.param(
            "zmq --host 10.99.0.2 --port 5555 --no-auth", "--url tcp://10.99.0.2:5555", marks=pytest.mark.slow
        ),
        pytest.param(
            "ros --middleware cyclonedds --namespace /llama",
            "--url ros:///llama --transport ros/topic,ros/action --middleware cyclonedds --mode stream --fps 5 "
            "--size 160x120",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["http", "websocket", "zmq", "dds"],
)
def test_true_one_way_times_are_in_all_intervals(tmp_path: Path, serve: str, measure: str) -> None:
    run = read_run(measured(tmp_path, serve, measure))
    samples = run.samples
    assert not any(samples["error"])
    assert samples["network_ns"].isna().all()
    assert samples["return_ns"].isna().all()
    reports = [json.loads(line) for line in (tmp_path / "marks.jsonl").read_text().splitlines()]
    true_ns = [[(stamp - OFFSET_NS) * 10**6 // (10**6 + PPM) for _, stamp in marks] for marks in reports]
    for sample in samples.to_dict("records"):
        marks = json.loads(sample["marks"])
        ((sent, _),) = [(before, after) for before, after in pairwise(marks) if after[0] == "network"]
        seen = marks[-1]
        assert seen[0] == "return"
        (server,) = [stamps for stamps in true_ns if sent[1] <= stamps[0] and stamps[-1] <= seen[1]]
        for name, truth in (("network", server[0] - sent[1]), ("return", seen[1] - server[-1])):
            lo, hi = sample[f"{name}_lo_ns"], sample[f"{name}_hi_ns"]
            assert lo - 10 <= truth <= hi + 10
        assert sample["round_trip_ns"] == pytest.approx(seen[1] - sent[1] - (server[-1] - server[0]), abs=1e6)
