"""The ROS server beyond the contract: the camera's cache, the queue, and being alone."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack
from dataclasses import replace
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import MessagesLost, RequestFailed, TransportError
from s2a_bench.ros import messages as ros
from s2a_bench.ros.service import READER_QOS
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import RESIDUAL, Trace, budget
from s2a_bench.transport import Client, Handler, Wiring, open_client, open_server
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.ros import topic
from s2a_bench.transport.ros.joining import join
from s2a_bench.transport.ros.wire import REQUEST_QOS, request_message
from s2a_bench.transport.serving import Queued
from s2a_bench.types import Request, Token
from tests.waiting import until


def serve(stack: ExitStack, wiring: Wiring[Any], handler: Handler) -> Any:
    return stack.enter_context(served(wiring, handler))[0]


def connect(stack: ExitStack, wiring: Wiring[Any]) -> Client:
    client = open_client(wiring)
    stack.callback(client.close)
    return client


@pytest.fixture
def wiring(dds_domain: int) -> Wiring[Any]:
    return wiring_of("ros/topic", "/test_ros", domain_id=dds_domain)


def ask_until_seen(client: Client, handler: RecordingHandler, stamp_ns: int) -> Trace:
    """Ask without a picture until the server has the frame of a stamp."""
    deadline = now_ns() + 20_000_000_000
    while now_ns() < deadline:
        _, trace = ask(client, Request("a", "plan"))
        assert trace.remote is not None
        if trace.remote.frame_stamp_ns == stamp_ns:
            return trace
        handler.requests.clear()
    raise AssertionError("the server never got the frame")


@pytest.mark.parametrize("payload", ["raw", "yuyv", "jpeg", "png"])
def test_a_request_without_a_picture_is_about_the_newest_frame(
    stack: ExitStack, wiring: Wiring[Any], dds_domain: int, payload: str
) -> None:
    import cv2

    handler = RecordingHandler(["x"])
    serve(stack, wiring, handler)
    client = connect(stack, wiring_of("ros/topic", wiring.address, domain_id=dds_domain, payload=payload))
    assert client.camera is not None
    for seed in (1, 2):
        frame, published = yuyv_frame(seed=seed), Trace()
        published.mark(RESIDUAL)
        client.camera.publish(frame, published)
    trace = ask_until_seen(client, handler, client.camera.stamp_ns(frame))
    (image,) = handler.requests[-1].images
    if payload != "jpeg":
        np.testing.assert_array_equal(image.data, cv2.cvtColor(frame.data, cv2.COLOR_YUV2RGB_YUY2))
    assert trace.remote is not None
    stages = [stage for stage, _ in trace.remote.frame_marks]
    decoding = {"raw": "channel_swap", "yuyv": "yuv_decode"}.get(payload, "image_decode")
    assert stages == ["network", "cdr_parse", decoding]
    assert decoding not in budget(trace.chain()).stages_ns


def test_a_client_is_a_camera_from_when_it_is_used_as_one(stack: ExitStack, wiring: Wiring[Any]) -> None:
    server = serve(stack, wiring, RecordingHandler(["x"]))
    clients = [connect(stack, replace(wiring, variant=variant)) for variant in ("topic", "action")]

    def publishers() -> int:
        return sum(server._cache._publishers().values())

    assert publishers() == 0
    for count, client in enumerate(clients, 1):
        assert client.camera is client.camera
        until(lambda count=count: publishers() == count)  # type: ignore[misc]  # bound at once


def test_a_waiting_request_is_about_the_frame_that_is_the_newest_when_its_turn_comes(
    stack: ExitStack, dds_domain: int
) -> None:
    go, started, seen = Event(), Event(), list[int]()

    def handler(request: Request, _trace: Trace) -> Generator[Token, None, None]:
        seen.extend(image.stamp_ns for image in request.images)
        started.set()
        assert go.wait(20)
        yield Token(0, "x")

    queued = Queued.around(handler)
    wiring = wiring_of("ros/topic", "/test_turn", domain_id=dds_domain)
    server = serve(stack, wiring, queued)
    clients = [connect(stack, wiring) for _ in range(2)]
    threads = [Thread(target=ask, args=(client, Request("a", "plan"))) for client in clients]
    threads[0].start()
    assert started.wait(20)
    camera = clients[1].camera
    assert camera is not None
    threads[1].start()
    until(lambda: bool(queued.turns.waiting))
    frame = yuyv_frame()
    camera.publish(frame, Trace())
    until(lambda: server._cache._newest is not None)
    go.set()
    for thread in threads:
        thread.join(20)
    assert seen == [camera.stamp_ns(frame)]


@pytest.mark.parametrize(("came", "told_of"), [([0, 2], "piece 2 came instead of 1"), ([0, 0], "piece 0 .* of 1")])
def test_tokens_out_of_order_are_messages_lost(
    stack: ExitStack, wiring: Wiring[Any], came: list[int], told_of: str
) -> None:
    def handler(_request: Request, trace: Trace) -> Generator[Token, None, None]:
        trace.mark("inference")
        for index in came:
            yield Token(index, "x")

    serve(stack, wiring, handler)
    answer = connect(stack, wiring).request(Request("a", "plan"), Trace())
    assert next(answer).index == 0
    with pytest.raises(MessagesLost, match=told_of):
        next(answer)


@pytest.mark.parametrize(("variant", "says"), [("topic", "no token for 1 s"), ("action", "no feedback for 1 s")])
def test_a_silent_server_is_given_up(stack: ExitStack, dds_domain: int, variant: str, says: str) -> None:
    over = Event()

    def silent(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        over.wait(20)
        yield Token(0, "x")

    wiring = wiring_of(f"ros/{variant}", "/test_silent", domain_id=dds_domain, timeout_s=1.0)
    serve(stack, wiring, silent)
    stack.callback(over.set)
    with pytest.raises(RequestFailed, match=says):
        ask(connect(stack, wiring), Request("a", "plan"))


def test_a_second_server_of_a_namespace_is_refused(stack: ExitStack, wiring: Wiring[Any]) -> None:
    serve(stack, wiring, RecordingHandler(["x"]))
    with pytest.raises(TransportError, match="another server answers under /test_ros"):
        open_server(wiring, RecordingHandler(["y"]))


def test_the_first_token_waits_for_the_reader_of_a_client_that_appears_late(
    stack: ExitStack, from_pypi: str, dds_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topic, "REACH_S", 20.0)
    wiring = wiring_of("ros/topic", "/test_late", domain_id=dds_domain, middleware=from_pypi)
    wiring = replace(wiring, address=serve(stack, wiring, RecordingHandler(["x"])).address)
    late, other = (join(wiring, name) for name in ("late", "other"))
    for middleware in (late, other):
        stack.callback(middleware.close)
    requests = late.publisher("/test_late/request", ros.REQUEST, REQUEST_QOS)
    bystander = other.subscription("/test_late/token", ros.TOKEN, READER_QOS)
    until(lambda: requests.matched() and bystander.matched())
    requests.send(requests.pack(request_message(Request("a", "plan", max_tokens=1))))
    assert bystander.take(0.5) is None
    tokens = late.subscription("/test_late/token", ros.TOKEN, READER_QOS)
    packed = tokens.take(20)
    assert packed is not None
    assert tokens.unpack(packed).text == "x"


def test_a_client_without_a_reader_is_waited_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    waited, sent = list[str](), list[Any]()
    monkeypatch.setattr(topic, "appeared", lambda *_: waited.append("once"))
    requests = SimpleNamespace(take=None, interrupt=None, sender=None)
    tokens = SimpleNamespace(pack=lambda message: message, send=sent.append)
    middleware: Any = SimpleNamespace(subscription=lambda *_: requests, publisher=lambda *_: tokens)
    source = topic.TopicSource(middleware, "/test", LIMITS)
    for index in range(2):
        source.send("a", "sender", Token(index, "x"), [])
    assert waited == ["once"]
    assert [token.index for token in sent] == [0, 1]
