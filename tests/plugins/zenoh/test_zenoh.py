"""Zenoh keeps the contract of middlewares and actions, in the names of rmw_zenoh."""

from __future__ import annotations

import importlib
import socket
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.errors import TransportError
from s2a_bench.plugins.zenoh import endpoint_of, free_endpoint, listens
from s2a_bench.ros import QoS, Rejected, Result, llama, open_middleware
from s2a_bench.ros import messages as ros
from tests.ros.action_suite import NAME, ActionSuite, event, offer, receive, start
from tests.ros.middleware_suite import (
    GET_TYPES,
    STRING,
    WAIT_S,
    Join,
    MiddlewareSuite,
    joining,
    text,
    until,
    wait_matched,
)
from tests.ros.words import hears_them, served
from tests.suites import only

pytest.importorskip("zenoh", reason="the extra zenoh is not installed")
names = importlib.import_module("s2a_bench.plugins.zenoh.names")
node = importlib.import_module("s2a_bench.plugins.zenoh.node")


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def router_inside(endpoint: str, domain: int) -> AbstractContextManager[Join]:
    """Join sessions of which the first is the router."""
    first = iter([True])
    return joining(lambda: open_middleware("zenoh", domain_id=domain, place=endpoint, host=next(first, False)))


@contextmanager
def router_apart(endpoint: str, domain: int) -> Iterator[Join]:
    """Join sessions that meet at a router that is not one of them."""
    with router_inside(endpoint, domain) as join:
        join()
        yield join


@pytest.fixture
def join(endpoint: str, dds_domain: int) -> Iterator[Join]:
    with router_inside(endpoint, dds_domain) as join:
        yield join


@pytest.fixture
def routed(endpoint: str, dds_domain: int) -> Iterator[Join]:
    with router_apart(endpoint, dds_domain) as join:
        yield join


class TestZenoh(MiddlewareSuite):
    """With a session as the router; the tests below have a router of its own."""


class TestZenohActions(ActionSuite):
    """With a session as the router."""


@only(
    "test_publishers_are_told_with_type_and_reliability_until_they_leave",
    "test_a_sender_hears_a_publisher_once_it_subscribes",
    "test_services_answer_who_asked",
)
class TestZenohRouterApart(MiddlewareSuite):
    @pytest.fixture
    def join(self, routed: Join) -> Join:
        return routed


@only(
    "test_all_goals_are_cancelled_at_once",
    "test_two_clients_get_only_their_own",
    "test_a_server_that_left_is_missed",
)
class TestZenohActionsRouterApart(ActionSuite):
    @pytest.fixture
    def join(self, routed: Join) -> Join:
        return routed


@pytest.fixture
def stranger(routed: Join, endpoint: str) -> Iterator[Any]:
    """A session that is no ROS node."""
    del routed
    session = node.open_session(endpoint, host=False)
    yield session
    session.close()


def tokens_of(session: Any, domain: int) -> list[str]:
    replies = session.liveliness().get(f"@ros2_lv/{domain}/**")
    return sorted(str(reply.ok.key_expr) for reply in replies)


def test_peers_see_our_node_and_its_endpoints_until_it_leaves(stranger: Any, endpoint: str, dds_domain: int) -> None:
    named = open_middleware("zenoh", domain_id=dds_domain, node_name="/robot/brain", place=endpoint)
    ends = (
        named.publisher("/camera", ros.IMAGE, QoS(depth=1)),
        named.subscription("/camera", ros.IMAGE, QoS(depth=5, reliable=False)),
        named.service_client("/ask", GET_TYPES),
        named.action_client(NAME, llama.GENERATE_RESPONSE),
    )
    named.service("/ask", GET_TYPES, lambda _: None)
    named.action_server(NAME, llama.GENERATE_RESPONSE)
    until(lambda: sum("/brain/" in token for token in tokens_of(stranger, dds_domain)) == 14)
    seen = [token.split("/")[5:] for token in tokens_of(stranger, dds_domain) if "/brain" in token]
    assert ["NN", "%", "%robot", "brain"] in seen
    image = ("sensor_msgs::msg::dds_::Image_", ros.type_hash(ros.IMAGE))
    asks = ("rcl_interfaces::srv::dds_::GetParameterTypes_", ros.type_hash(GET_TYPES))
    who = ["%", "%robot", "brain"]
    assert ["MP", *who, "%camera", *image, "::,1:,:,:,,"] in seen
    assert ["MS", *who, "%camera", *image, "2::,5:,:,:,,"] in seen
    for kind in ("SS", "SC"):
        assert [kind, *who, "%ask", *asks, "::,10:,:,:,,"] in seen
        for service in ("send_goal", "get_result", "cancel_goal"):
            assert any(
                each[0] == kind and each[4:5] == [f"%llama%generate_response%_action%{service}"] for each in seen
            )
    assert len([each for each in seen if each[0] in {"MP", "MS"}]) == 6
    del ends
    named.close()
    until(lambda: not any("/brain" in token for token in tokens_of(stranger, dds_domain)))


def test_a_latched_topic_is_there_for_who_joins_later(routed: Join) -> None:
    publisher = routed().publisher("/latched", STRING, QoS(depth=2, latched=True))
    for value in ("one", "two", "three"):
        publisher.send(publisher.pack(text(value)))
    late = routed().subscription("/latched", STRING, QoS(depth=5, latched=True))
    assert [late.unpack(late.take(WAIT_S)).data for _ in range(2)] == ["two", "three"]
    publisher.send(publisher.pack(text("four")))
    assert late.unpack(late.take(WAIT_S)).data == "four"
    assert late.take(0.05) is None


def test_nothing_listens_beyond_loopback(endpoint: str, dds_domain: int) -> None:
    before = {*links()}
    with router_inside(endpoint, dds_domain) as join:
        join()
        join()
        inodes = {link[8:-1] for link in map(str, {*links()} - before) if link.startswith("socket:")}
        rows = [
            (kind, row[1], row[3])
            for kind in ("tcp", "tcp6", "udp", "udp6")
            for row in map(str.split, Path("/proc/net", kind).read_text().splitlines()[1:])
            if row[9] in inodes
        ]
    listening = {at.partition(":")[0] for kind, at, state in rows if kind.startswith("tcp") and state == "0A"}
    assert listening == {"0100007F"}
    assert not [at for kind, at, _ in rows if kind.startswith("udp")]


def links() -> Iterator[Path]:
    """What this process has open."""
    for each in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            yield each.readlink()


@pytest.mark.parametrize("attachment", [None, b"", bytes(20), bytes(33), b"\xff" * 1000])
def test_a_message_without_its_attachment_is_dropped_and_told_once(
    routed: Join, stranger: Any, attachment: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    publisher, subscription = (
        routed().publisher("/topic", STRING, QoS()),
        routed().subscription("/topic", STRING, QoS(0)),
    )
    wait_matched(publisher, subscription)
    key = f"{publisher._node.domain_id}/topic/std_msgs::msg::dds_::String_/{ros.type_hash(STRING)}"  # type: ignore[attr-defined]
    for _ in range(20):
        stranger.put(key, bytes(publisher.pack(text("x"))), attachment=attachment)
    publisher.send(publisher.pack(text("whole")))
    assert subscription.unpack(subscription.take(WAIT_S)).data == "whole"
    until(lambda: subscription.take(0.05) is None and caplog.records)
    assert [record.getMessage()[:26] for record in caplog.records] == ["/topic: dropped a message:"]


def test_a_message_past_its_lifespan_is_not_delivered(routed: Join, stranger: Any) -> None:
    publisher = routed().publisher("/brief", STRING, QoS(lifespan_s=10))
    subscription = routed().subscription("/brief", STRING, QoS(0, lifespan_s=10))
    wait_matched(publisher, subscription)
    old = names.ATTACHMENT.pack(1, time.time_ns() - 11_000_000_000, 16, bytes(16))
    stranger.put(f"*/brief/**/{ros.type_hash(STRING)}", bytes(publisher.pack(text("old"))), attachment=old)
    publisher.send(publisher.pack(text("young")))
    assert subscription.unpack(subscription.take(WAIT_S)).data == "young"


def test_garbage_to_a_service_is_dropped_and_told_once(
    routed: Join, stranger: Any, caplog: pytest.LogCaptureFixture
) -> None:
    routed().service("/ask", GET_TYPES, lambda asked: ros.default(GET_TYPES + "_Response", types=[len(asked.names)]))
    client = routed().service_client("/ask", GET_TYPES)
    assert client.call(ros.default(GET_TYPES + "_Request", names=["a"]), WAIT_S).types.tolist() == [1]
    stamp, head = names.ATTACHMENT.pack(1, 0, 16, bytes(16)), b"\0\1\0\0"
    key = f"*/ask/**/{ros.type_hash(GET_TYPES)}"
    for body in (b"", head, head + b"\xff\xff\xff\x7f", head + b"\xff" * 64):
        for _ in range(10):
            assert [*stranger.get(key, payload=body, attachment=stamp)] == [], "no reply, and the query ends"
    assert [*stranger.get(key)] == []
    assert [*stranger.get(key, payload=head, attachment=bytes(7))] == []
    assert client.call(ros.default(GET_TYPES + "_Request", names=["a", "b"]), WAIT_S).types.tolist() == [2]
    said = [record.getMessage().partition(":")[2] for record in caplog.records]
    assert [one[:24] for one in said] == [" dropped a request: 0 by", " dropped a request: 0 by"]


def test_malformed_requests_leave_an_action_up(routed: Join, stranger: Any, caplog: pytest.LogCaptureFixture) -> None:
    action = offer(routed)
    stamp = names.ATTACHMENT.pack(1, 0, 16, bytes(16))
    for service in ("send_goal", "cancel_goal", "get_result"):
        for body in (b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(9)):
            assert action.server.next_goal(0) is None
            stranger.get(f"*{NAME}/_action/{service}/**", payload=body, attachment=stamp)
            assert action.server.next_goal(0.05) is None
    damaged = action.client.pack(llama.generate_goal("p"))
    damaged[20:24] = b"\xff\xff\xff\x7f"  # the prompt's length
    action.client.send(damaged)
    goal = receive(action.server)
    with pytest.raises(TransportError, match="bytes that are not a llama_msgs/action/GenerateResponse_SendGoal"):
        goal.unpack()
    goal.reject()
    event(action.client, Rejected)
    start(action).succeed(llama.text_result("x"))
    event(action.client, Result)
    assert all("dropped a" in record.getMessage() for record in caplog.records)


def test_versions_of_llama_msgs_that_differ_are_told_on_both_sides(
    routed: Join, caplog: pytest.LogCaptureFixture
) -> None:
    routed().action_server(NAME, llama.GENERATE_RESPONSE, version="4.4")
    client = routed().action_client(NAME, llama.GENERATE_RESPONSE)
    assert client.wait_for_server(WAIT_S)
    assert client.server_version() == "4.4"
    until(lambda: caplog.messages)
    assert caplog.messages == [
        f"{NAME}: a client waits in vain: it speaks llama_msgs 6.0, this server 4.4 (--llama-msgs)"
    ]
    spoken = routed().action_client(NAME, llama.GENERATE_RESPONSE, "4.4")
    assert spoken.wait_for_server(WAIT_S)
    assert spoken.server_version() == "4.4"


def test_without_a_router_one_line_says_where_to_get_one(endpoint: str) -> None:
    with pytest.raises(TransportError, match=rf"no Zenoh router answers at {endpoint} .*: start one \(ros2 run"):
        open_middleware("zenoh", place=endpoint)


def test_a_router_that_says_nothing_is_given_up(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.plugins.zenoh.node.OPEN_MS", 100)
    with socket.create_server(("127.0.0.1", endpoint_of(endpoint)[2])), pytest.raises(TransportError, match="no Zenoh"):
        open_middleware("zenoh", place=endpoint)


def test_a_port_that_is_taken_is_named(endpoint: str) -> None:
    with (
        socket.create_server(("127.0.0.1", endpoint_of(endpoint)[2])),
        pytest.raises(TransportError, match=r"cannot be the Zenoh router .*`router`"),
    ):
        open_middleware("zenoh", place=endpoint, host=True)


def test_an_inbox_is_bounded_and_says_once_that_it_is_full(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(node, "HELD_BYTES", 10_000)
    inbox: Any = node.SampleQueue("/x", node.Bell())
    took = [inbox.put(number, 1000) for number in range(9)]
    assert took == [True] * 4 + [False] * 5
    assert [*inbox.arrived()] == [0, 1, 2, 3]
    assert inbox.put(9, 1000)
    assert caplog.messages == ["/x: messages are dropped: 0 MiB wait to be taken"]
    last: Any = node.SampleQueue("/x", node.Bell(), depth=2)
    assert all(last.put(number, 1000) for number in range(9))
    assert [*last.arrived()] == [7, 8]


def test_a_message_that_is_too_large_is_dropped_and_the_next_arrives(
    monkeypatch: pytest.MonkeyPatch, endpoint: str, dds_domain: int
) -> None:
    monkeypatch.setattr("s2a_bench.plugins.zenoh.node.MESSAGE_BYTES", 1 << 20)
    with router_inside(endpoint, dds_domain) as join:
        subscription, publisher = join().subscription("/x", STRING, QoS(0)), join().publisher("/x", STRING, QoS())
        wait_matched(publisher, subscription)
        for value in ("a" * (3 << 20), "whole"):
            publisher.send(publisher.pack(text(value)))
        assert subscription.unpack(subscription.take(WAIT_S)).data == "whole"


def test_a_server_that_was_the_router_may_die_and_come_back(endpoint: str, dds_domain: int) -> None:
    with served("zenoh", dds_domain, endpoint) as server:
        until(lambda: listens(endpoint))
        middleware = open_middleware("zenoh", domain_id=dds_domain, place=endpoint)
        client = middleware.action_client(NAME, llama.GENERATE_RESPONSE)
        hears_them(client, WAIT_S)
        server.kill()
    until(lambda: not client.server_present())
    with served("zenoh", dds_domain, endpoint) as server:
        hears_them(client, WAIT_S)
        server.kill()
    middleware.close()
