"""Every middleware keeps the contract, and Cyclone speaks ROS 2's names."""

from __future__ import annotations

import sys
from contextlib import closing

import pytest

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.ros import MIDDLEWARES, QoS, default_middleware, open_middleware
from tests.ros.middleware_suite import STRING, MiddlewareSuite, wait_matched

cyclonedds = pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")


class TestCyclone(MiddlewareSuite):
    """In a domain of Cyclone DDS."""


def test_a_domain_takes_one_configuration_per_process(dds_domain: int) -> None:
    open_middleware("cyclonedds", domain_id=dds_domain).close()
    with pytest.raises(TransportError, match="already configured otherwise"):
        open_middleware("cyclonedds", domain_id=dds_domain, tuning="default")


def test_without_a_domain_that_of_the_environment_is_joined(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the command line does, so that a program's node and a measurement meet."""
    named = open_middleware("cyclonedds", domain_id=dds_domain)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(dds_domain))
    with closing(named), closing(open_middleware("cyclonedds")) as node:
        wait_matched(named.publisher("/test/word", STRING, QoS()), node.subscription("/test/word", STRING, QoS()))
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID: '233' is not a number from 0 to 232"):
        open_middleware("cyclonedds")


def test_an_unknown_middleware_is_named() -> None:
    with pytest.raises(UsageError, match="`middleware`: 'iceoryx' is not one of cyclonedds, rclpy, zenoh"):
        open_middleware("iceoryx")


@pytest.mark.parametrize(("name", "way_out"), [("cyclonedds", "--transport"), ("zenoh", r"pip install '.\[zenoh\]'")])
def test_a_missing_package_is_named_with_the_way_out(name: str, way_out: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, MIDDLEWARES[name].opens.partition(":")[0], None)
    with pytest.raises(TransportError, match=rf"{name} is not installed.*{way_out}.*of a source.*\?middleware=$"):
        open_middleware(name)


JAZZY = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}


@pytest.mark.parametrize(
    ("environ", "there", "expected"),
    [
        (JAZZY, "rclpy cyclonedds", "rclpy"),
        (JAZZY, "", "cyclonedds"),
        ({"ROS_DISTRO": "jazzy"}, "rclpy", "cyclonedds"),
        ({"AMENT_PREFIX_PATH": "/ws/install"}, "rclpy", "cyclonedds"),
        ({}, "rclpy", "cyclonedds"),
        ({}, "cyclonedds zenoh", "cyclonedds"),
        ({}, "zenoh", "zenoh"),
        ({}, "zenoh rclpy", "zenoh"),
        (JAZZY, "zenoh", "zenoh"),
        ({}, "", "cyclonedds"),
    ],
)
def test_rclpy_is_chosen_where_ros_is_sourced_and_zenoh_where_it_alone_is_there(
    environ: dict[str, str], there: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("s2a_bench.ros.find_spec", lambda name: name in there.split() or None)
    assert default_middleware(environ) == expected
