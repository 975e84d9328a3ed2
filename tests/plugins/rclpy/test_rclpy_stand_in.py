"""The glue around rclpy keeps the contracts, on a stand-in for rclpy inside this process."""

from __future__ import annotations

import gc
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import closing
from threading import Thread
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import MissingInterface, TransportError
from s2a_bench.ros import Accepted, Feedback, QoS, Result, Tuning, llama, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.config import CYCLONE_URI, LARGE_PICTURES, RMW_CYCLONE
from s2a_bench.scenario.longitudinal import Longitudinal
from s2a_bench.scenario.ros import EgoParameters, RosEgo
from s2a_bench.testing.transport import RecordingHandler, ask, connector, wiring_of, yuyv_frame
from s2a_bench.transport import open_client, open_server
from s2a_bench.transport.ros import ROS
from s2a_bench.types import Frame, Request
from tests.plugins.rclpy.rclpy_stand_in import GRAPH, INTERFACES, PACKAGES, action, generated, modules
from tests.ros.action_suite import NAME, ActionSuite
from tests.ros.middleware_suite import Join, MiddlewareSuite, joining
from tests.suites import only

GLUE = ("client", "middleware", "node", "server", "types")


@pytest.fixture(scope="module", autouse=True)
def ros_2() -> Iterator[None]:
    """A sourced environment, as far as the glue sees it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, content in modules().items():
            patch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(content)
        for package in (*PACKAGES, "unique_identifier_msgs"):
            for kind, make in INTERFACES.items():
                name = f"{package}.{kind}"
                patch.setitem(sys.modules, name, ModuleType(name))
                prefix = f"{package}/{kind}/"
                vars(sys.modules[name])["__getattr__"] = lambda part, make=make, prefix=prefix: make(prefix + part)
        for part in GLUE:
            patch.delitem(sys.modules, f"s2a_bench.plugins.rclpy.{part}", raising=False)
        yield
        for part in GLUE:
            sys.modules.pop(f"s2a_bench.plugins.rclpy.{part}", None)


@pytest.fixture
def join() -> Iterator[Join]:
    with joining(lambda: open_middleware("rclpy", domain_id=7, node_name="/robot/bench")) as join:
        yield join
    assert GRAPH == []


def test_a_goal_that_has_ended_goes_with_its_pictures_at_once() -> None:
    """Its handle's ends are no cycle, for which Python would look when it likes."""
    from s2a_bench.plugins.rclpy.server import RclpyServerGoal

    goal = RclpyServerGoal(None, (None, SimpleNamespace(goal_id=SimpleNamespace(uuid=bytes(16)))))
    gone = weakref.ref(goal)
    gc.disable()
    try:
        del goal
        assert gone() is None
    finally:
        gc.enable()


@pytest.mark.parametrize(
    ("rmw", "uri", "tuning", "given"),
    [
        (RMW_CYCLONE, "", "tuned", LARGE_PICTURES),
        (RMW_CYCLONE, "", "default", ""),
        (RMW_CYCLONE, "/own.xml", "tuned", "/own.xml"),
        ("rmw_fastrtps_cpp", "", "tuned", ""),
    ],
)
def test_rmw_cyclonedds_has_room_for_large_pictures_unless_the_user_configures_it(
    monkeypatch: pytest.MonkeyPatch, rmw: str, uri: str, tuning: Tuning, given: str
) -> None:
    seen: list[str] = []
    rclpy = sys.modules["rclpy"]
    join = rclpy.create_node
    monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: rmw)
    monkeypatch.setattr(
        rclpy, "create_node", lambda *of, **how: seen.append(os.environ.get(CYCLONE_URI, "")) or join(*of, **how)
    )
    monkeypatch.setenv(CYCLONE_URI, uri)
    with closing(open_middleware("rclpy", domain_id=7, tuning=tuning)) as middleware:
        about = middleware.describe()
    assert seen == [about["configuration"]] == [given]
    assert about["tuning"] == ("tuned" if given == LARGE_PICTURES else "default")
    assert os.environ.get(CYCLONE_URI, "") == uri  # Cyclone DDS from PyPI would read it in a run beside


class TestRclpyGlue(MiddlewareSuite):
    """As far as the stand-in shows it."""


class TestRclpyActionGlue(ActionSuite):
    """As from rclpy 7.1.8 on."""


@only(
    "test_a_goal_is_accepted_answered_token_by_token_and_ends_with_its_result",
    "test_an_aborted_goal_says_so",
    "test_a_goal_is_cancelled_in_mid_stream",
    "test_a_goal_cancelled_while_it_queues_does_not_start",
    "test_a_result_can_be_asked_for_again_until_it_expires",
    "test_a_client_that_left_harms_nobody",
)
class TestRclpyActionGlueUntil717(ActionSuite):
    """How goals end, before."""

    @pytest.fixture(autouse=True)
    def release(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("tests.plugins.rclpy.rclpy_stand_in.OLD_ENDS", [True])


def test_an_image_is_published_as_ready_cdr_and_its_pixels_are_views_of_what_arrives(join: Join) -> None:
    publisher = join().publisher("/image", ros.IMAGE, QoS(1))
    subscription = join().subscription("/image", ros.IMAGE, QoS(1))
    pixels = np.random.default_rng(1).integers(0, 256, (480, 640, 3), np.uint8)
    packed = publisher.pack(ros.image_message(Frame(0, 0, 640, 480, "bgr8", pixels), 0, "camera"))
    assert type(packed) is bytes
    publisher.send(packed)
    got = subscription.take(5)
    data = subscription.unpack(got).data
    assert data.tobytes() == pixels.tobytes()
    assert not data.flags.owndata
    assert np.shares_memory(data, np.frombuffer(got, np.uint8))


def test_an_inbox_keeps_the_newest_as_its_qos_says(join: Join) -> None:
    publisher = join().publisher("/number", "std_msgs/msg/String", QoS(10))
    middleware = join()
    newest = middleware.subscription("/number", "std_msgs/msg/String", QoS(2))
    every = middleware.subscription("/number", "std_msgs/msg/String", QoS(0))
    for number in range(5):
        publisher.send(publisher.pack(ros.message("std_msgs/msg/String", data=str(number))))
    assert [every.unpack(every.take(5)).data for _ in range(5)] == ["0", "1", "2", "3", "4"]
    assert [newest.unpack(newest.take(5)).data for _ in range(2)] == ["3", "4"]


def test_a_result_is_given_out_after_all_feedback(join: Join) -> None:
    server = join().action_server(NAME, llama.GENERATE_RESPONSE)
    client: Any = join().action_client(NAME, llama.GENERATE_RESPONSE)
    goal_id = client.send(client.pack(llama.generate_goal("p")))
    goal = server.next_goal(5)
    goal.accept()
    goal.executing()
    with client.lock:  # the client's thread stops after its first take, while all of this arrives
        for number in range(30):
            goal.feedback(llama.token_feedback(str(number), number))
        goal.succeed(llama.text_result("..."))
    events = [client.next_event(5) for _ in range(32)]
    assert [type(event) for event in events] == [Accepted, *[Feedback] * 30, Result]
    assert {event.goal_id for event in events} == {goal_id}


def test_a_package_that_is_not_built_is_named_with_the_way_out(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    middleware = join()
    monkeypatch.setitem(sys.modules, "s2a_msgs.msg", None)
    with pytest.raises(TransportError, match=r"s2a_msgs/msg/Token is not in.*colcon build --packages-select s2a_msgs"):
        middleware.publisher("/token", ros.TOKEN, QoS())


def without_llama_msgs(patch: pytest.MonkeyPatch) -> None:
    for kind in INTERFACES:
        patch.setitem(sys.modules, f"llama_msgs.{kind}", None)


def test_topics_are_served_without_llama_msgs_and_the_log_says_what_is_not(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    without_llama_msgs(monkeypatch)
    wiring = wiring_of("ros/topic", "/s2a", middleware="rclpy", domain_id=7)
    with closing(connector(wiring)) as connecting:
        client = next(connecting)(RecordingHandler(["a ", "b"]))
        tokens, _ = ask(client, Request("a", "plan", (yuyv_frame(),)))
    assert [token.text for token in tokens] == ["a ", "b"]
    assert "the action is not served: llama_msgs/action/GenerateResponse is not in this ROS 2 workspace" in caplog.text
    assert "colcon build --packages-select llama_msgs" in caplog.text
    assert ROS.ready(wiring).startswith("serving topics below /s2a, camera")
    assert GRAPH == []


def test_the_action_needs_llama_msgs_and_so_do_topics_where_its_version_is_an_option(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_llama_msgs(monkeypatch)
    action = wiring_of("ros/action", "/s2a", middleware="rclpy", domain_id=7)
    topic = wiring_of("ros/topic", "/s2a", middleware="rclpy", domain_id=7, llama_msgs="4.4")
    for opened in (
        lambda: open_server(action, RecordingHandler([])),
        lambda: open_client(action),
        lambda: open_server(topic, RecordingHandler([])),
    ):
        with pytest.raises(MissingInterface, match="colcon build --packages-select llama_msgs"):
            opened()
    assert GRAPH == []


def test_an_ego_over_ros_needs_the_package_of_its_commands() -> None:
    for message, package in (("control", "carla_msgs"), ("ackermann", "ackermann_msgs")):
        how = EgoParameters(middleware="rclpy", domain_id=7, message=message)  # type: ignore[arg-type]
        with pytest.raises(MissingInterface, match=rf"^`ego`: ros: {package}/.*--packages-select {package}` and"):
            RosEgo(Longitudinal(), how)
    assert GRAPH == []


def test_an_interface_with_other_fields_is_refused(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = classmethod(lambda _: {"id": "string", "index": "uint32"})
    older = type("Token", (generated(ros.TOKEN),), {"get_fields_and_field_types": fields})
    monkeypatch.setitem(vars(sys.modules["s2a_msgs.msg"]), "Token", older)
    with pytest.raises(TransportError, match="s2a_msgs/msg/Token of this ROS 2 workspace has other fields than ours"):
        join().publisher("/token", ros.TOKEN, QoS())


def test_the_version_of_llama_msgs_is_the_workspaces(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    older = lambda part: generated(f"llama_msgs/msg/{part}", "4.4")  # noqa: E731
    monkeypatch.setitem(vars(sys.modules["llama_msgs.msg"]), "__getattr__", older)
    monkeypatch.setitem(
        vars(sys.modules["llama_msgs.action"]), "GenerateResponse", action(llama.GENERATE_RESPONSE, "4.4")
    )
    client = join().action_client(NAME, llama.GENERATE_RESPONSE)
    assert client.server_version() == "4.4"
    with pytest.raises(TransportError, match=r"this workspace has llama_msgs 4\.4, not 6\.0"):
        client.pack(llama.generate_goal("p"))
    assert join().action_server(NAME, llama.GENERATE_RESPONSE).version == "4.4"
    with pytest.raises(TransportError, match=r"this workspace has llama_msgs 4\.4, not 6\.0"):
        join().action_server(NAME, llama.GENERATE_RESPONSE, version="6.0")


def test_an_executor_still_tells_of_a_qos_that_does_not_fit(join: Join) -> None:
    join().subscription("/x", "std_msgs/msg/String", QoS())
    (node,) = GRAPH
    (handler,) = node.handlers
    assert handler.callback_group is node.default_callback_group


def test_closing_waits_for_a_consumer_that_waits(join: Join) -> None:
    middleware = join()
    subscription = middleware.subscription("/x", "std_msgs/msg/String", QoS())
    client = middleware.action_client(NAME, llama.GENERATE_RESPONSE)
    got: list[Any] = []
    consumers = [
        Thread(target=lambda take=take: got.append(take(60))) for take in (subscription.take, client.next_event)
    ]
    for consumer in consumers:
        consumer.start()
    middleware.close()
    for consumer in consumers:
        consumer.join(10)
    assert got == [None, None]
    assert subscription.take(0) is None


def test_without_a_name_the_environment_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.ros.default_middleware", lambda environ: "rclpy" if environ is os.environ else "")
    middleware = open_middleware(domain_id=7)
    assert middleware.describe()["middleware"] == "rclpy"
    middleware.close()
