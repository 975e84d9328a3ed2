"""The Cyclone DDS configuration that follows from the user's ROS environment."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.ros.config import configuration, domain_id


def parse(environ: dict[str, str], tuning: str = "tuned") -> ET.Element:
    xml = configuration(environ, tuning)  # type: ignore[arg-type]
    assert xml is not None
    return ET.fromstring(xml)  # noqa: S314 - our own text


@pytest.mark.parametrize(
    ("environ", "interfaces", "multicast", "found"),
    [
        ({}, ["127.0.0.1"], "false", ["127.0.0.1"]),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"}, [], "true", []),
        (
            {"ROS_STATIC_PEERS": "192.168.0.7;robot-1.lan"},
            *([], "false", ["127.0.0.1", "192.168.0.7", "robot-1.lan"]),
        ),
    ],
    ids=["loopback", "subnet", "static peers"],
)
def test_dds_stays_on_loopback_unless_asked(
    environ: dict[str, str], interfaces: list[str], multicast: str, found: list[str]
) -> None:
    root = parse(environ)
    assert [interface.get("address") for interface in root.iter("NetworkInterface")] == interfaces
    assert root.findtext(".//AllowMulticast") == multicast
    assert [peer.get("address") for peer in root.iter("Peer")] == found


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("ROS_STATIC_PEERS", "not a host", "'not a host'"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "moon", "'MOON' is not one of OFF"),
        *(("ROS_DOMAIN_ID", text, "") for text in ("-1", "233", "x", "1.5")),
    ],
)
def test_a_variable_that_makes_no_sense_is_named(name: str, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=f"{name}: {message}"):
        _ = domain_id({name: text}), configuration({name: text}, "tuned")


@pytest.mark.parametrize(("text", "expected"), [("", 0), ("0", 0), ("42", 42), ("232", 232)])
def test_the_domain_is_ros_domain_id(text: str, expected: int) -> None:
    assert domain_id({"ROS_DOMAIN_ID": text}) == expected


def test_tuning_is_there_or_not() -> None:
    tuned, default = parse({}), parse({}, "default")
    assert tuned.findtext(".//FragmentSize") == "65000B"
    assert tuned.findtext(".//MaxMessageSize") == "65500B"
    assert tuned.find(".//SocketReceiveBufferSize").get("max") == "16MB"  # type: ignore[union-attr]
    assert default.find(".//FragmentSize") is None
    assert default.find(".//SocketReceiveBufferSize") is None


def test_the_users_own_configuration_wins() -> None:
    assert configuration({"CYCLONEDDS_URI": "file:///x.xml"}, "tuned") is None


def test_addresses_where_nobody_answers_yet_are_not_given_up() -> None:
    xml = configuration({}, "tuned")
    assert xml is not None
    assert "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>" in xml
