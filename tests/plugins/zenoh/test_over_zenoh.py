"""Transports, robots, cameras and the doctor over Zenoh."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from s2a_bench.act import ActionKind, kind
from s2a_bench.act.ros import TRAJECTORY, RosRobot
from s2a_bench.cli.doctor import all_checks
from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames.ros import TopicCamera
from s2a_bench.machine.doctor import Finding, Machine, examine
from s2a_bench.plugins.zenoh import free_endpoint
from s2a_bench.policy.parameters import build
from s2a_bench.ros import QoS, open_middleware
from s2a_bench.ros.join import RosParameters
from s2a_bench.scenario.ros import EgoParameters
from s2a_bench.store.run import read_run
from s2a_bench.testing.transport import TransportSuite, wiring_of
from s2a_bench.transport import Choice, Wiring
from s2a_bench.transport.pipeline import one_pipeline
from tests.cli.test_latency import SMALL, only_run, run
from tests.cli.test_serve import ONE_BY_ONE, Start, start  # noqa: F401 - a fixture
from tests.ros.middleware_suite import WAIT_S

pytest.importorskip("zenoh", reason="the extra zenoh is not installed")


class TestRosTopicOverZenoh(TransportSuite):
    lacks: ClassVar[frozenset[str]] = frozenset({"accept"})

    @pytest.fixture
    def wiring(self, dds_domain: int) -> Wiring[Any]:
        return wiring_of("ros/topic?middleware=zenoh", domain_id=dds_domain)


class TestRosActionOverZenoh(TransportSuite):
    carries_id_and_limit = False

    @pytest.fixture
    def wiring(self, dds_domain: int) -> Wiring[Any]:
        return wiring_of("ros/action?middleware=zenoh", domain_id=dds_domain, max_tokens=2000)


def test_two_servers_of_a_run_are_each_the_zenoh_router_of_their_clients(tmp_path: Path) -> None:
    cells = "ros/topic?middleware=zenoh,ros/action?middleware=zenoh,ros/topic?middleware=zenoh&qos=sensor_data"
    run(*SMALL, "--transport", cells, "--mode", "stream", output=tmp_path)
    kept = only_run(tmp_path)
    assert (kept.samples["error"] == "").all()
    assert len(set(kept.samples["cell"])) == 3
    servers = [server["transport"] for server in kept.manifest["servers"].values()]
    assert [server["router_is"] for server in servers] == ["this process"] * 2
    assert len({server["router"] for server in servers}) == 2


def test_two_servers_and_a_black_box_meet_at_one_router(
    start: Start,  # noqa: F811
    dds_domain: int,
    tmp_path: Path,
) -> None:
    over = ("--engine", "echo", "--middleware", "zenoh", "--router", router := free_endpoint())
    over += ("--max-tokens", "50", *ONE_BY_ONE)
    _, line = start("ros", *over, "--namespace", "/first")
    assert f"in domain {dds_domain} of the Zenoh router {router}, which this server is; engine" in line
    _, line = start("ros", *over, "--namespace", "/second")
    assert f"in domain {dds_domain} of the Zenoh router {router}; engine" in line
    arguments = ["latency", "--transport", f"ros?middleware=zenoh&router={router}&action=/second/generate_response"]
    arguments += ["--engine", "echo", "--requests", "3", "--warmup", "1", "--max-tokens", "4", "--size", "64x48"]
    arguments += ["--data-only", "--output", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "s2a_bench", *arguments], check=True, timeout=120, capture_output=True)
    (folder,) = tmp_path.iterdir()
    samples = read_run(folder).samples
    assert (samples["error"] == "").all()
    assert (samples["n_tokens"] == 4).all()


def test_over_zenoh_nodes_meet_at_a_router(dds_domain: int) -> None:
    endpoint = free_endpoint()
    controller = open_middleware("zenoh", domain_id=dds_domain, place=endpoint, host=True)
    listener = controller.subscription("/arm", TRAJECTORY, QoS())
    robot = kind(f"ros?topic=/arm&middleware=zenoh&router={endpoint}", ActionKind).open_actions(2, 20_000_000)
    robot.send(np.array([1, 2], np.float32), now_ns())
    message = listener.unpack(listener.take(WAIT_S))
    assert message.points[0].positions.tolist() == [1, 2]
    robot.close()
    controller.close()


def test_a_camera_without_a_router_is_one_line() -> None:
    with pytest.raises(SourceError, match=r"^`source`: ros:/c.*: no Zenoh router answers at .* with \?router=$"):
        TopicCamera(f"/c?middleware=zenoh&router={free_endpoint()}", 64, 48)


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        ({}, "no router listens at tcp/127.0.0.1:7447"),
        ({"proc/net/tcp": "  sl  local st\n  0: 0100007F:1D17 00000000:0000 0A 0\n"}, "a router listens at tcp/"),
        ({"proc/net/tcp6": "  sl  local st\n  0: 0:1D17 0:0000 0A 0\n"}, "a router listens at tcp/"),
        ({"proc/net/tcp": "  0: 0100007F:9999 0100007F:1D17 01 0\n  1: 0100007F:1D17 0:0 01 0\nx\n"}, "no router"),
    ],
)
def test_its_router_is_looked_for(tmp_path: Path, tree: dict[str, str], says: str) -> None:
    for path, text in tree.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    finding = examined(Machine(tmp_path, finds=lambda _package: True))
    assert finding.level == "state"
    assert finding.message.startswith(says)


def test_a_router_is_zenohs() -> None:
    ros = one_pipeline("ros?middleware=cyclonedds&router=tcp/127.0.0.1:7447")
    with pytest.raises(UsageError, match="`router` is Zenoh's: choose `middleware` zenoh, or leave it out"):
        ros.transport.require(Choice(ros.options, "topic", mode="request", engine="echo"))


@pytest.mark.parametrize("made_by", [RosParameters, RosRobot, EgoParameters])
def test_a_parameter_that_is_no_endpoint_is_refused(made_by: type[RosParameters]) -> None:
    with pytest.raises(UsageError, match=r"router: 'here' should look like tcp/127\.0\.0\.1:7447"):
        build(made_by, "ros?router=here")


def examined(machine: Machine) -> Finding:
    (finding,) = examine(machine, {"zenoh": all_checks()["zenoh"]})
    return finding


def test_the_doctor_says_how_to_install_it(tmp_path: Path) -> None:
    finding = examined(Machine(tmp_path, finds=lambda _package: False))
    assert (finding.level, finding.message) == ("state", "not installed")
    assert finding.fix == "pip install '.[zenoh]' in the clone of s2a-bench"
