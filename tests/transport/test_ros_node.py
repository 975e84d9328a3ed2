"""Our server as a node that behaves: parameters, /rosout and /diagnostics, as a peer on DDS or Zenoh meets them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any

import pytest
from pydantic.alias_generators import to_snake

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.inference import EngineConfig
from s2a_bench.ros import Middleware, QoS, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.ros.parameters import PARAMETER, SERVICE, value_message, value_of
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.transport.ros.joining import join
from s2a_bench.transport.ros.node import (
    ARRAY,
    EVENT,
    LOG,
    Activity,
    Level,
    PartHealth,
    diagnostic_array,
    log_message,
)
from s2a_bench.transport.ros.server import RosServer
from s2a_bench.transport.serving import STUCK_S, Queued
from s2a_bench.types import Request
from tests.waiting import until

NODE = "/behaves/brain"
WAIT_S = 20.0


@pytest.fixture
def wiring(from_pypi: str, dds_domain: int) -> Wiring[Any]:
    """What a server is told."""
    options = {"middleware": from_pypi, "domain_id": dds_domain, "node_api": True, "node_name": "brain"}
    return wiring_of("ros/topic?max_tokens=9", "/behaves", **options)


@pytest.fixture
def client(stack: ExitStack, wiring: Wiring[Any], server: RosServer) -> Client:
    return stack.enter_context(closing(open_client(replace(wiring, address=server.address))))


@pytest.fixture
def peer(stack: ExitStack, wiring: Wiring[Any], server: RosServer) -> Middleware:
    return stack.enter_context(closing(join(replace(wiring, address=server.address), "peer")))


@pytest.fixture
def server(stack: ExitStack, wiring: Wiring[Any]) -> RosServer:
    """A server as `serve ros` starts it."""
    handler = Queued.around(RecordingHandler(["a", "b"]))
    handler.settings = EngineConfig(name="echo")
    server, _ = stack.enter_context(served(wiring, handler))
    assert isinstance(server, RosServer)
    return server


def call(peer: Middleware, service: str, **fields: Any) -> Any:
    type_name = SERVICE + service
    request = ros.default(type_name + "_Request", **fields)
    return peer.service_client(f"{NODE}/{to_snake(service)}", type_name).call(request, WAIT_S)


def received(subscription: Subscription, wanted: Callable[[Any], bool]) -> Any:
    """The first message that is wanted."""
    found: list[Any] = []

    def came() -> bool:
        if packed := subscription.take(0.2):
            found.append(subscription.unpack(packed))
        return bool(found) and wanted(found[-1])

    until(came)
    return found[-1]


@pytest.mark.usefixtures("server")
def test_the_options_are_parameters(peer: Middleware) -> None:
    names = call(peer, "ListParameters").result.names
    assert len(names) == len(set(names))
    asked = ["namespace", "max_tokens", "engine", "model", "max_waiting", "use_sim_time", "llama_msgs"]
    assert set(asked) < set(names)
    values = [value_of(value) for value in call(peer, "GetParameters", names=asked).values]
    assert values == ["/behaves", 9, "echo", None, 64, False, "6.0"]


def test_a_limit_can_be_set_while_it_runs_and_everybody_hears(peer: Middleware, server: RosServer) -> None:
    events = peer.subscription("/parameter_events", EVENT, QoS(depth=1000))
    until(events.matched)
    call(peer, "ListParameters")  # once that is answered, the server has found the subscription too
    wanted = {"max_tokens": 3, "feedback_interval": 0.25, "namespace": "/other"}
    parameters = [ros.default(PARAMETER, name=name, value=value_message(value)) for name, value in wanted.items()]
    results = call(peer, "SetParameters", parameters=parameters).results
    assert [(each.successful, each.reason[:32]) for each in results[:2]] == [(True, ""), (True, "")]
    assert "namespace is read-only" in results[2].reason
    heard = [received(events, lambda event: bool(event.changed_parameters)) for _ in range(2)]
    assert [event.node for event in heard] == [NODE, NODE]
    assert [event.changed_parameters[0].name for event in heard] == ["max_tokens", "feedback_interval"]
    assert (server._action.max_tokens, server._action.feedback_interval_ns) == (3, 250_000_000)


def test_what_is_logged_is_on_rosout_for_who_joins_later(peer: Middleware) -> None:
    logging.getLogger("s2a_bench.somewhere").warning("the %s is low", "battery")
    rosout = peer.subscription("/rosout", LOG, QoS(depth=1000, latched=True))
    log = received(rosout, lambda log: "battery" in log.msg)
    assert (log.name, log.level, log.msg) == ("behaves.brain", 30, "the battery is low")
    assert log.file.endswith("test_ros_node.py")


def test_diagnostics_tell_of_requests_and_the_camera(peer: Middleware, client: Client) -> None:
    diagnostics = peer.subscription("/diagnostics", ARRAY, QoS())
    assert client.camera is not None
    client.camera.publish(yuyv_frame(), Trace())
    assert ask(client, Request("a", "plan"))[0]

    def counted(array: Any) -> bool:
        requests, camera = map(values_of, array.status)
        return requests["requests"] == camera["frames"] == "1"

    array = received(diagnostics, counted)
    requests, camera = array.status
    assert (requests.name, requests.level) == ("behaves/brain: requests", Level.OK)
    assert values_of(requests)["failures"] == values_of(requests)["waiting"] == "0"
    assert camera.name == "behaves/brain: camera"
    assert float(values_of(camera)["frame_age_s"]) >= 0
    assert requests.hardware_id


def test_a_request_that_cannot_be_prepared_is_a_failure(
    server: RosServer, client: Client, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        with pytest.raises(RequestFailed):
            ask(client, Request("a", "plan", max_tokens=0))
    failures = [record.getMessage() for record in caplog.records if "a request failed" in record.getMessage()]
    assert failures == ["a request failed: max_tokens should be a whole number of 1 to 65536"]
    assert server._shared.activity.failures == 2


def values_of(status: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def activity(waiting: int = 0, silent_s: float = 0.0) -> Activity:
    return Activity(lambda: waiting, 4, lambda: silent_s)


@pytest.mark.parametrize(
    ("made", "level", "message"),
    [
        (activity(), Level.OK, "idle"),
        (activity(silent_s=0.1), Level.OK, "answering"),
        (activity(waiting=4), Level.WARN, "the queue is full"),
        (activity(silent_s=STUCK_S + 1), Level.ERROR, "no sign of life for 121 s"),
    ],
)
def test_the_level_says_what_is_wrong_with_requests(made: Activity, level: Level, message: str) -> None:
    requests, _ = made.findings(0, None, str, 1)
    assert requests.level is level
    assert message in requests.message


def test_failures_and_old_frames_are_warnings_and_a_failure_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    made = activity()
    for number in range(3):
        made.failed(f"no model for {number}.5 s")
    requests, camera = made.findings(7, now_ns() - 5_000_000_000, lambda: "2 publishers", 1)
    assert (requests.level, requests.message) == (Level.WARN, "3 requests failed")
    assert (camera.level, camera.values["frames"]) == (Level.WARN, 7)
    assert camera.message == "the newest frame is 5.0 s old: 2 publishers"
    assert camera.values["frame_age_s"] >= 5
    assert [record.getMessage() for record in caplog.records] == ["a request failed: no model for 0.5 s"]
    requests, camera = made.findings(8, now_ns(), lambda: "2 publishers", 60)
    assert (requests.level, camera.level) == (Level.OK, Level.OK)


def test_a_log_is_cleaned() -> None:
    hostile = "a\0b\ud800"
    record = logging.LogRecord("n", 35, "f.py", 3, hostile, (), None, "run")
    log = ros.deserialise(memoryview(bytes(ros.serialise(log_message(record, "n"), LOG))), LOG)
    assert log.msg == "a\ufffdb?"
    assert (log.level, log.function, log.line) == (30, "run", 3)


def test_diagnostics_survive_the_wire() -> None:
    sent = diagnostic_array("/a/b", [PartHealth("c", Level.ERROR, "d", {"e": 0.5})], 5_000_000_007)
    array = ros.deserialise(memoryview(bytes(ros.serialise(sent, ARRAY))), ARRAY)
    (status,) = array.status
    assert ros.nanoseconds(array.header.stamp) == 5_000_000_007
    assert (status.level, status.name, status.message, values_of(status)) == (2, "a/b: c", "d", {"e": "0.5"})
    made_by_rosidl_of_jazzys_file = "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
    assert ros.type_hash(ARRAY) == "RIHS01_" + made_by_rosidl_of_jazzys_file


@pytest.mark.parametrize("from_pypi", ["cyclonedds"], indirect=True)
def test_rosout_and_parameter_events_have_the_qos_that_was_recorded(server: RosServer, dds_domain: int) -> None:
    import json
    from pathlib import Path

    from cyclonedds.core import Policy

    from tests.ros.test_cyclone_action import announced

    wire = json.loads((Path(__file__).parent.parent / "data" / "action_wire.json").read_text())
    ends = {(end["kind"], end["topic"]): end for end in wire["endpoints"]}
    wanted = {("writer", "rt/rosout"), ("writer", "rt/parameter_events")}
    found = announced(dds_domain, wanted)
    assert server.address == "/behaves"
    for end in wanted:
        ours, recorded = found[end].qos, ends[end]
        policies = {"reliability": Policy.Reliability, "durability": Policy.Durability, "history": Policy.History}
        policies |= {"userdata": Policy.Userdata, "repr": Policy.DataRepresentation}
        assert {name: repr(ours[policy]) for name, policy in policies.items()} == {
            name: recorded[name] for name in policies
        }
        assert found[end].type_name == recorded["type"]
    assert found["writer", "rt/rosout"].qos[Policy.Lifespan] == Policy.Lifespan(10_000_000_000)
