"""Actions on Cyclone DDS: the contract, what is announced as ROS announces it, and what a stranger may send."""

from __future__ import annotations

import json
import re
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.ros import Accepted, Feedback, Rejected, Result, llama, open_middleware
from s2a_bench.ros import messages as ros
from tests.ros.action_suite import NAME, WAIT_S, Action, ActionSuite, event, offer, receive, send, start
from tests.ros.middleware_suite import Join, until
from tests.ros.words import hears_them, served

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

WIRE = json.loads((Path(__file__).parent.parent / "data" / "action_wire.json").read_text())
RECORDED = {(end["kind"], end["topic"]): end for end in WIRE["endpoints"] if "generate" in end["topic"]}
DISCOVERY = "ros_discovery_info"
OURS = {
    ("reader", r"rq/generate/.*Request|rr/generate/.*Reply|rt/generate/_action/feedback"): "Policy.History.KeepAll",
    ("writer", r"rt/generate/_action/feedback|rr/generate/.*Reply"): "Policy.History.KeepLast(depth=1000)",
}
"""Where our history, which is local and matches any other, is deeper than ROS's."""


@pytest.fixture
def action(join: Join) -> Action:
    return offer(join)


class TestCycloneActions(ActionSuite):
    """In a domain of Cyclone DDS."""


def test_a_cancel_counts_though_its_client_has_left_since(action: Action, monkeypatch: pytest.MonkeyPatch) -> None:
    server: Any = action.server
    goal = start(action)
    monkeypatch.setattr(server._cancel, "reaches", lambda _: False)
    action.client.cancel(goal.id)
    until(lambda: goal.cancel_requested)


def announced(domain: int, wanted: set[tuple[str, str]]) -> dict[tuple[str, str], Any]:
    """What a third participant discovers of these (kind, topic)."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
    from cyclonedds.domain import DomainParticipant

    observer = DomainParticipant(domain)
    readers = {
        "writer": BuiltinDataReader(observer, BuiltinTopicDcpsPublication),
        "reader": BuiltinDataReader(observer, BuiltinTopicDcpsSubscription),
    }
    found: dict[tuple[str, str], Any] = {}

    def look() -> None:
        for kind, reader in readers.items():
            found.update({(kind, end.topic_name): end for end in reader.take(N=100)})

    until(lambda: wanted <= found.keys(), look)
    return found


def test_endpoints_are_announced_as_ros_announces_them(join: Join, dds_domain: int) -> None:
    from cyclonedds.core import Policy

    ends = (
        join().action_server("/generate", llama.GENERATE_RESPONSE, version="4.4"),
        join().action_client("/generate", llama.GENERATE_RESPONSE, version="4.4"),
    )
    assert len(RECORDED) == 16
    found = announced(dds_domain, set(RECORDED))
    del ends  # unreferenced, a client leaves
    for (kind, topic), recorded in RECORDED.items():
        ours = found[kind, topic]
        history = next(
            (ours for (of, name), ours in OURS.items() if of == kind and re.fullmatch(name, topic)),
            recorded["history"],
        )
        assert ours.type_name == recorded["type"]
        assert repr(ours.qos[Policy.Reliability]) == recorded["reliability"]
        assert repr(ours.qos[Policy.Durability]) == recorded["durability"]
        assert repr(ours.qos[Policy.History]) == history
        assert repr(ours.qos[Policy.DataRepresentation]) == recorded["repr"]
        identity = r"((?:clientid|serviceid)=)[ 0-9a-f][0-9a-f](?:\.[0-9a-f]{1,2}){15};"
        user_data = repr(ours.qos[Policy.Userdata])
        assert re.sub(identity, r"\1;", user_data) == re.sub(identity, r"\1;", recorded["userdata"])


def test_request_and_reply_endpoints_of_a_service_share_an_id(join: Join, dds_domain: int) -> None:
    from s2a_bench.ros.dds import user_data

    middleware = join()
    middleware.action_server("/generate", llama.GENERATE_RESPONSE)
    services = [f"/generate/_action/{name}" for name in ("send_goal", "cancel_goal", "get_result")]
    pairs = [(("reader", f"rq{name}Request"), ("writer", f"rr{name}Reply")) for name in services]
    found = announced(dds_domain, {end for pair in pairs for end in pair})
    ids = [{user_data(found[end])["serviceid"] for end in pair} for pair in pairs]
    assert [len(of_one) for of_one in ids] == [1, 1, 1]
    assert len(set.union(*ids)) == 3


def test_an_id_is_written_as_recorded() -> None:
    from s2a_bench.ros.dds_service import endpoint_id

    prefix = bytes.fromhex(WIRE["participants"][1]["guid"].replace("-", ""))[:12]
    assert (
        f"clientid={endpoint_id(prefix, 8)};" in RECORDED["writer", "rq/generate/_action/send_goalRequest"]["userdata"]
    )


def test_a_node_is_listed_by_name_with_its_endpoints(dds_domain: int) -> None:
    from s2a_bench.ros import QoS
    from s2a_bench.ros.cyclone import PARTICIPANT_ENTITIES
    from s2a_bench.ros.dds import DdsWaiter, RawReader, dds_qos

    listening = open_middleware(domain_id=dds_domain)
    named = open_middleware(domain_id=dds_domain, node_name="/llama/llama_node")
    try:
        publisher = named.publisher("/x", "std_msgs/msg/String", QoS())
        named.action_server(NAME, llama.GENERATE_RESPONSE)
        participant = listening._participant  # type: ignore[attr-defined]
        reader = RawReader(participant, DISCOVERY, PARTICIPANT_ENTITIES, dds_qos(QoS(0, latched=True), ""))
        waiter = DdsWaiter(participant)
        waiter.watch(reader)
        deadline = now_ns() + 20_000_000_000
        nodes: dict[str, Any] = {}
        while not (node := nodes.get("llama_node")) or len(node.writer_gid_seq) < 6:
            packed = reader.take()
            if packed is None:
                assert waiter.wait_until(deadline), "not announced"
                continue
            for node in ros.deserialise(packed, PARTICIPANT_ENTITIES).node_entities_info_seq:
                nodes[node.node_name] = node
        assert node.node_namespace == "/llama"
        assert publisher.entity.get_guid().bytes in [gid.data.tobytes()[:16] for gid in node.writer_gid_seq]  # type: ignore[attr-defined]
        assert len(node.reader_gid_seq) == 3
    finally:
        named.close()
        listening.close()


def test_what_is_no_node_name_is_refused(dds_domain: int) -> None:
    with pytest.raises(UsageError, match="node name 'my node'"):
        open_middleware(domain_id=dds_domain, node_name="my node")


def test_replies_to_other_clients_are_ignored(join: Join) -> None:
    from s2a_bench.ros.dds_service import HEADER, HEADER_AT, Caller

    action = offer(join)
    sent = send(action.client)
    goal: Any = receive(action.server)
    service = goal._server.send_goal
    guid, number = HEADER.unpack_from(goal._packed, HEADER_AT)
    response = ros.default(service.spec.reply_type, accepted=False)
    service.respond(service.pack(response), Caller(0, (guid ^ 1, number)))
    service.respond(service.pack(response), Caller(0, (guid, number + 7)))
    goal.accept()
    assert event(action.client, Accepted).goal_id == sent


def test_malformed_requests_leave_the_server_up(join: Join, caplog: pytest.LogCaptureFixture) -> None:
    action = offer(join)
    client: Any = action.client
    for service in (client._goals, client._cancels, client._results):
        service.writer.send(bytearray.fromhex("00010000") + bytes(16))
    damaged = client.pack(llama.generate_goal("p"))
    damaged[36:40] = b"\xff\xff\xff\x7f"  # the prompt's length
    client.send(damaged)
    goal = receive(action.server)
    with pytest.raises(TransportError, match="bytes that are not a llama_msgs/action/GenerateResponse_SendGoal"):
        goal.unpack()
    goal.reject()
    event(client, Rejected)
    start(action).succeed(llama.text_result("x"))
    event(client, Result)
    assert [record.getMessage()[: len(NAME) + 10] for record in caplog.records] == [NAME + ": dropped "] * 3


def test_client_and_server_are_two_processes(join: Join, dds_domain: int) -> None:
    client = join().action_client(NAME, llama.GENERATE_RESPONSE)
    with served("cyclonedds", dds_domain) as process:
        hears_them(client, 30)
        assert process.stdin is not None
        process.stdin.close()
    assert process.returncode == 0
    until(lambda: not client.server_present(), lambda: client.next_event(0.01))


def test_a_server_may_send_faster_than_its_client_reads(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client looks at what has come, and takes no result before what was sent before it."""
    client = (action := offer(join)).client
    goal = start(action)
    goal.feedback(llama.token_feedback("on", 1))
    packed = event(client, Feedback).packed
    goal.succeed(llama.text_result("on", [1]))
    taken = count(1)

    def never_empty() -> memoryview:
        assert next(taken) < 100_000, "the client takes without end"
        return packed

    with monkeypatch.context() as patched:
        patched.setattr(client._feedback.__self__, "take", never_empty)  # type: ignore[attr-defined]
        came = [client.next_event(WAIT_S) for _ in range(2500)]
    assert {type(one) for one in came} == {Feedback}
    rest = iter(lambda: client.next_event(1), None)
    assert [type(one) for one in rest if not isinstance(one, Feedback)] == [Result]


def test_peers_that_come_while_they_are_counted_do_no_harm(action: Action, monkeypatch: pytest.MonkeyPatch) -> None:
    """cyclonedds reads past its list where a peer has joined between two calls: the service thread died of it."""
    readers = action.server._get_result.writer  # type: ignore[attr-defined]
    real, calls = readers._handles, count()

    def grows() -> list[int]:
        if not next(calls) % 2:
            raise IndexError("invalid index")
        return list(real())

    monkeypatch.setattr(readers, "_handles", grows)
    goal = start(action)
    goal.succeed(llama.text_result("on", [1]))
    assert event(action.client, Result).goal_id == goal.id
    assert next(calls)


def test_a_request_that_breaks_the_service_leaves_its_thread(action: Action, monkeypatch: pytest.MonkeyPatch) -> None:
    service = action.server._get_result  # type: ignore[attr-defined]
    real, calls = service.reaches, count()

    def breaks(caller: object) -> bool:
        if not next(calls):
            raise ValueError("whatever")
        return bool(real(caller))

    monkeypatch.setattr(service, "reaches", breaks)
    first = start(action)
    first.succeed(llama.text_result("on", [1]))
    second = start(action)
    second.succeed(llama.text_result("on", [1]))
    assert event(action.client, Result).goal_id == second.id
