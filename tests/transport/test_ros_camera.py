"""Requests without a picture, by what the camera's topic brings: frames, publishers without frames, or nothing."""

from __future__ import annotations

import logging
import re
from contextlib import ExitStack
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.ros import Middleware, Publisher, QoS, Result, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.transport.ros import camera as camera_module
from s2a_bench.transport.ros.camera import CAMERA, CAMERA_QOS, CLOCK_QOS
from s2a_bench.transport.ros.joining import join
from s2a_bench.transport.ros.node import ARRAY, Level
from s2a_bench.types import Frame, Request
from tests.suites import once
from tests.waiting import until

TOPIC = "/robot/camera/image_raw"
BLIND = f"no picture: 1 publisher on {TOPIC}, no frame comes: look at the buffers (qos reliable"
WAIT_S = 20.0


@pytest.fixture
def wiring(from_pypi: str, dds_domain: int) -> Wiring[Any]:
    """What a server is told."""
    options = {"middleware": from_pypi, "domain_id": dds_domain, "node_api": True, "max_frame_age": 0.3}
    return wiring_of("ros/topic", "/robot", **options)


class Robot:
    """A server, and a peer in its domain."""

    def __init__(self, stack: ExitStack, wiring: Wiring[Any]) -> None:
        self.handler = RecordingHandler(["x"])
        self.server: Any = stack.enter_context(served(wiring, self.handler))[0]
        self._stack, self._told = stack, replace(wiring, address=self.server.address)
        self.peer = self.join()

    def join(self) -> Middleware:
        middleware = join(self._told, "peer")
        self._stack.callback(middleware.close)
        return middleware

    def client(self, variant: str = "topic") -> Client:
        client = open_client(replace(self._told, variant=variant))
        self._stack.callback(client.close)
        return client

    def camera(self, qos: str = "reliable", middleware: Middleware | None = None) -> Publisher:
        """A publisher on the camera's topic that the server knows."""
        publisher = (middleware or self.peer).publisher("/robot" + CAMERA, ros.IMAGE, CAMERA_QOS[qos])
        until(lambda: self.server._cache._publishers().get("/robot" + CAMERA, 0) == 1)
        return publisher

    def diagnosed(self, diagnostics: Subscription, wanted: str) -> Any:
        """The first status of the camera whose message matches."""
        deadline = now_ns() + int(WAIT_S * 1e9)
        while now_ns() < deadline:
            if (packed := diagnostics.take(0.2)) is not None:
                _, status = diagnostics.unpack(packed).status
                if re.search(wanted, status.message):
                    return status
        raise AssertionError("it did not come")


@pytest.fixture
def robot(stack: ExitStack, wiring: Wiring[Any]) -> Robot:
    return Robot(stack, wiring)


def refusal(client: Client) -> str:
    """Why a request without a picture fails."""
    with pytest.raises(RequestFailed) as raised:
        ask(client, Request("a", "plan"))
    return str(raised.value)


def logged(caplog: pytest.LogCaptureFixture, part: str) -> list[str]:
    return [message for message in caplog.messages if part in message]


def test_goals_without_a_picture_are_aborted_where_no_frame_of_the_camera_comes(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    kept = robot.camera()
    goals = robot.peer.action_client("/robot/generate_response", GENERATE_RESPONSE)
    assert goals.wait_for_server(WAIT_S)
    results = []
    for _ in range(6):
        goals.send(goals.pack(generate_goal("plan")))
        while not isinstance(event := goals.next_event(WAIT_S), Result):
            assert event is not None
        results.append((event.status, goals.unpack_result(event.packed).response.text[: len(BLIND)]))
    assert results == [(Status.ABORTED, BLIND)] * 6
    assert robot.handler.requests == []
    assert len(logged(caplog, BLIND)) == 1
    goals.send(goals.pack(generate_goal("plan", [ros.image_message(yuyv_frame(), 1, "camera")])))
    while not isinstance(event := goals.next_event(WAIT_S), Result):
        assert event is not None
    assert event.status == Status.SUCCEEDED
    assert [len(request.images) for request in robot.handler.requests] == [1]
    del kept


def test_a_request_on_the_topic_fails_too_and_is_answered_again_once_the_publisher_has_left(robot: Robot) -> None:
    client, other = robot.client(), robot.join()
    kept = robot.camera(middleware=other)
    assert BLIND in refusal(client)
    other.close()
    until(lambda: robot.server._cache._publishers().get("/robot" + CAMERA, 0) == 0)
    assert ask(client, Request("b", "plan"))[0]
    assert [request.images for request in robot.handler.requests] == [()]
    del kept


@once
def test_diagnostics_warn_of_a_camera_whose_frames_do_not_come(robot: Robot) -> None:
    diagnostics = robot.peer.subscription("/diagnostics", ARRAY, QoS())
    status = robot.diagnosed(diagnostics, "^no camera: no publisher on its topics$")
    assert status.level == Level.OK
    publisher = robot.camera()
    status = robot.diagnosed(diagnostics, f"^1 publisher on {TOPIC}, no frame comes: look at the buffers")
    assert status.level == Level.WARN
    publisher.send(publisher.pack(ros.image_message(yuyv_frame(), 1, "camera")))
    status = robot.diagnosed(diagnostics, f"^the newest frame is .* s old: 1 publisher on {TOPIC}, no frame comes")
    assert status.level == Level.WARN


@once
@pytest.mark.parametrize("variant", ["topic", "action"])
def test_without_a_publisher_text_is_answered_and_the_log_says_once_that_there_is_no_camera(
    robot: Robot, caplog: pytest.LogCaptureFixture, variant: str
) -> None:
    client = robot.client(variant)
    for _ in range(3):
        assert ask(client, Request("a", "plan"))[0]
    assert [request.images for request in robot.handler.requests] == [()] * 3
    (line,) = [record for record in caplog.records if "camera" in record.getMessage()]
    assert line.getMessage().startswith(f"no camera: no publisher on {TOPIC} or {TOPIC}/compressed; ")
    assert line.levelno == logging.WARNING


def test_a_request_waits_for_the_first_frame_of_a_publisher_that_has_just_appeared(
    stack: ExitStack, wiring: Wiring[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_module, "FIRST_FRAME_S", WAIT_S)
    robot = Robot(stack, replace(wiring, options=wiring.options.but(max_frame_age=60.0)))
    client, publisher = robot.client(), robot.camera()
    asking = Thread(target=ask, args=(client, Request("a", "plan")))
    asking.start()
    until(lambda: robot.server._shared.activity.requests == 1)
    publisher.send(publisher.pack(ros.image_message(yuyv_frame(), 7, "camera")))
    asking.join(WAIT_S)
    assert [[image.stamp_ns for image in request.images] for request in robot.handler.requests] == [[7]]


@once
def test_frames_that_cannot_be_used_are_named_as_the_reason(robot: Robot) -> None:
    client, publisher = robot.client(), robot.camera()
    depth = replace(ros.image_message(Frame(0, 0, 2, 2, "mono8", np.zeros((2, 2), np.uint8)), 1, "c"), encoding="16UC1")
    publisher.send(publisher.pack(depth))
    until(lambda: bool(robot.server._cache._unused))
    reason = rf"no picture: 1 publisher on {TOPIC}, none of its frames can be used: .*16UC1"
    assert re.search(reason, refusal(client))


@once
def test_the_log_has_each_reason_once_whatever_their_order(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    publisher, cache = robot.camera(), robot.server._cache
    good = ros.image_message(Frame(0, 0, 4, 4, "mono8", np.zeros((4, 4), np.uint8)), 1, "c")
    encodings = [{"encoding": each} for each in ("16UC1", "32FC1", "yuv9", "", "bgr8")]
    bad = [*encodings, {"width": 0}, {"height": 0}, {"height": 5}]
    until(lambda: publisher.matched() == 1)
    for changes in (*bad, *bad, {}):  # each is taken before the next is sent
        count = cache._count
        publisher.send(publisher.pack(replace(good, **changes)))
        until(lambda count=count: cache._count > count)  # type: ignore[misc]
    until(lambda: cache._newest is not None)
    lines = logged(caplog, "camera frame not used")
    assert len(lines) == len(set(lines)) == len(bad)


def test_ages_by_stamps_are_in_the_time_of_clock(
    stack: ExitStack, wiring: Wiring[Any], caplog: pytest.LogCaptureFixture
) -> None:
    options = wiring.options.but(use_sim_time=True, max_frame_age=60)
    robot = Robot(stack, replace(wiring, options=options))
    client, publisher, cache = robot.client(), robot.camera(), robot.server._cache
    until(lambda: publisher.matched() == 1)
    publisher.send(publisher.pack(ros.image_message(yuyv_frame(), 2_000_000_000, "camera")))
    until(lambda: cache._newest is not None)
    ages = {"camera_stamp_age_ms", "camera_sim_age_ms"}
    for _ in range(2):
        assert not ages & ask(client, Request("a", "plan"))[1].facts.keys()
    assert len(logged(caplog, "no time on /clock")) == 1
    clock = robot.peer.publisher("/clock", ros.CLOCK, CLOCK_QOS)
    packed = clock.pack(ros.message(ros.CLOCK, clock=ros.stamp(3_250_000_000)))

    def ticked() -> bool:
        clock.send(packed)
        return cache._sim_ns is not None

    until(ticked)
    facts = ask(client, Request("a", "plan"))[1].facts
    assert {name: facts[name] for name in ages & facts.keys()} == {"camera_sim_age_ms": 1250}


@pytest.mark.parametrize("from_pypi", ["cyclonedds"], indirect=True)
def test_a_best_effort_camera_that_a_reliable_server_does_not_match_is_no_missing_camera(robot: Robot) -> None:
    publisher = robot.camera("sensor_data")
    assert publisher.matched() == 0
    why = refusal(robot.client())
    assert BLIND in why
    assert why.endswith("; a best-effort publisher is received with qos sensor_data")


@once
def test_an_old_frame_is_told_of_with_buffers_while_there_is_a_publisher(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    client, other = robot.client(), robot.join()
    publisher = robot.camera(middleware=other)
    publisher.send(publisher.pack(ros.image_message(yuyv_frame(), 1, "camera")))
    cache = robot.server._cache
    until(lambda: cache._newest is not None and now_ns() - cache._newest.received_ns > 300_000_000)
    for _ in range(2):
        trace, came = Trace(), r"newest frame came \d+\.\d s ago, more than `max_frame_age` 0\.3 s"
        with pytest.raises(RequestFailed, match=f"{came}: 1 publisher on {TOPIC}, no frame comes: look at"):
            list(client.request(Request("a", "plan"), trace))
        assert trace.facts["stale_frames"] == 1
        assert 300 < trace.facts["camera_age_ms"] < trace.facts["camera_stamp_age_ms"] - 4_000  # by a stamp of 1970
    assert len(logged(caplog, "newest frame came")) == 1
    other.close()
    until(lambda: robot.server._cache._publishers().get("/robot" + CAMERA, 0) == 0)
    assert refusal(client).endswith("s: see whether the camera still publishes")
