"""Keys, tokens and attachments are those of rmw_zenoh: the examples are from its design document."""

from __future__ import annotations

import pytest

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.plugins.zenoh import endpoint_of, to_host
from s2a_bench.ros import QoS

names = pytest.importorskip(
    "s2a_bench.plugins.zenoh.names", reason="the extra zenoh is not installed", exc_type=ImportError
)

SESSION = "8b20917502ee955ac4476e0266340d5c"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_a_topic_has_the_documented_key() -> None:
    key = names.key(0, "/chatter", "std_msgs/msg/String", names.wire_hash("std_msgs/msg/String", "6.0"))
    assert key == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"


def test_humble_knows_no_type_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISTRO", "humble")
    assert names.wire_hash("std_msgs/msg/String", "6.0") == "TypeHashNotSupported"


def test_tokens_are_the_documented_ones() -> None:
    entity = names.Entity("MP", "%chatter", "std_msgs::msg::dds_::String_", STRING_HASH)
    token = names.endpoint_token(2, SESSION, 10, "/talker", entity, QoS(depth=7))
    rest = f"%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    assert token == f"@ros2_lv/2/{SESSION}/0/10/MP/%/%/talker/{rest}"
    assert names.entity_of(token) == entity
    node = names.node_token(2, SESSION, "/robot/arm/listener")
    assert node == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%robot%arm/listener"
    assert names.entity_of(node) is None


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (QoS(depth=10), "::,10:,:,:,,"),
        (QoS(depth=5, reliable=False), "2::,5:,:,:,,"),
        (QoS(depth=0, latched=True), ":1:2,:,:,:,,"),
        (QoS(depth=1000, latched=True, lifespan_s=10.5), ":1:,1000:,:10,500000000:,,"),
    ],
)
def test_a_qos_leaves_out_what_is_the_default(qos: QoS, text: str) -> None:
    assert names.qos_text(qos) == text


def test_a_gid_is_xxh3_of_the_token_low_half_first() -> None:
    # XXH3-128 of nothing is 99aa06d3014798d8 6001c324468d497f, the high half first
    assert names.gid_of("").hex() == "7f498d4624c30160d8984701d306aa99"


def test_an_attachment_has_33_bytes() -> None:
    data = names.ATTACHMENT.pack(3, 1_700_000_000_000_000_001, 16, bytes(range(16)))
    assert data.hex() == "0300000000000000" + "01002a36fe9c9717" + "10" + bytes(range(16)).hex()
    assert names.attached(data) == (3, 1_700_000_000_000_000_001, bytes(range(16)))


@pytest.mark.parametrize("data", [b"", bytes(17), bytes(33), bytes(32) + b"\x10", bytes(34), bytes(100_000)])
def test_what_is_no_attachment_is_refused(data: bytes) -> None:
    with pytest.raises(TransportError, match=f"{len(data)} bytes of attachment, where rmw_zenoh .* 33"):
        names.attached(data)


@pytest.mark.parametrize(
    "token",
    [
        "",
        "@ros2_lv",
        "@ros2_lv/0/a/0/1/MP/%/%/n/%x/T/h",
        "other/0/a/0/1/MP/%/%/n/%x/T/h/q",
        "@ros2_lv" + "/" * 12,
    ],
)
def test_what_is_no_token_is_nobody(token: str) -> None:
    assert names.entity_of(token) is None


@pytest.mark.parametrize(
    "text", ["", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/h:70000", "tcp/h:1#iface=eth0", "tcp/a b:1"]
)
def test_what_is_no_endpoint_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="should look like tcp/127"):
        endpoint_of(text)


def test_only_loopback_is_listened_on() -> None:
    hosts = {"tcp/127.0.0.1:1": True, "tcp/[::1]:1": True, "tcp/localhost:1": True, "tcp/0.0.0.0:1": False}
    hosts |= {"tcp/[::]:1": False, "tcp/192.168.1.2:1": False, "tcp/robot:1": False, "udp/127.0.0.1:1": False}
    assert {endpoint: bool(to_host(endpoint)) for endpoint in hosts} == hosts
