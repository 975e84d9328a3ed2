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


def peers(root: ET.Element) -> list[str | None]:
    return [peer.get("address") for peer in root.iter("Peer")]


def test_dds_stays_on_loopback_unless_asked() -> None:
    root = parse({})
    assert [interface.get("address") for interface in root.iter("NetworkInterface")] == ["127.0.0.1"]
    assert root.findtext(".//AllowMulticast") == "false"
    assert peers(root) == ["127.0.0.1"]


def test_tuning_is_there_or_not() -> None:
    tuned, default = parse({}), parse({}, "default")
    assert tuned.findtext(".//FragmentSize") == "65000B"
    assert tuned.findtext(".//MaxMessageSize") == "65500B"
    assert tuned.find(".//SocketReceiveBufferSize").get("max") == "16MB"  # type: ignore[union-attr]
    assert default.find(".//FragmentSize") is None
    assert default.find(".//SocketReceiveBufferSize") is None


def test_the_users_own_configuration_wins() -> None:
    assert configuration({"CYCLONEDDS_URI": "file:///x.xml"}, "tuned") is None


def test_a_subnet_is_used_when_asked_for() -> None:
    root = parse({"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"})
    assert root.find(".//NetworkInterface") is None
    assert root.findtext(".//AllowMulticast") == "true"


def test_static_peers_open_the_network_but_not_multicast() -> None:
    root = parse({"ROS_STATIC_PEERS": "192.168.0.7;robot-1.lan"})
    assert root.find(".//NetworkInterface") is None
    assert root.findtext(".//AllowMulticast") == "false"
    assert peers(root) == ["127.0.0.1", "192.168.0.7", "robot-1.lan"]


def test_a_peer_that_is_none_is_named() -> None:
    with pytest.raises(UsageError, match="ROS_STATIC_PEERS: 'not a host'"):
        configuration({"ROS_STATIC_PEERS": "not a host"}, "tuned")


def test_an_unknown_range_is_named() -> None:
    with pytest.raises(UsageError, match="ROS_AUTOMATIC_DISCOVERY_RANGE: 'MOON' is none of OFF"):
        configuration({"ROS_AUTOMATIC_DISCOVERY_RANGE": "moon"}, "tuned")


@pytest.mark.parametrize(("text", "expected"), [("", 0), ("0", 0), ("42", 42), ("232", 232)])
def test_the_domain_is_ros_domain_id(text: str, expected: int) -> None:
    assert domain_id({"ROS_DOMAIN_ID": text}) == expected


@pytest.mark.parametrize("text", ["-1", "233", "x", "1.5"])
def test_a_domain_that_is_none_is_named(text: str) -> None:
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID"):
        domain_id({"ROS_DOMAIN_ID": text})


def test_addresses_where_nobody_answers_yet_are_not_given_up() -> None:
    xml = configuration({}, "tuned")
    assert xml is not None
    assert "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>" in xml
