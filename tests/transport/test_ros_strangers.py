"""The ROS server among strangers of its domain: goals that are cancelled, names, limits, threads."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from threading import Event, active_count
from typing import Any

import pytest

from s2a_bench.harness.serving import engine_handler
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.ros import Accepted, Feedback, Middleware, QoS, Result, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal
from s2a_bench.ros.service import READER_QOS
from s2a_bench.testing.transport import RecordingHandler, ask, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.ros.joining import join
from s2a_bench.transport.ros.wire import request_message
from s2a_bench.transport.serving import Queued
from s2a_bench.types import Request, Token
from tests.transport.test_http import serving
from tests.waiting import until

NAMESPACE = "/s2a_bench"


@pytest.fixture
def stranger(dds_domain: int) -> Iterator[Middleware]:
    """Another node in the domain."""
    middleware = open_middleware(domain_id=dds_domain, node_name="/stranger")
    try:
        yield middleware
    finally:
        middleware.close()


def next_of(client: Any, *kinds: type) -> Any:
    """Wait for an event of one of ``kinds``."""
    while not isinstance(event := client.next_event(20), kinds):
        assert event is not None, f"no {kinds} came"
    return event


@pytest.fixture
def goals(stranger: Middleware) -> Callable[[], Any]:
    """Connect an action client to the server of the test."""

    def connect() -> Any:
        client = stranger.action_client(NAMESPACE + "/generate_response", GENERATE_RESPONSE)
        assert client.wait_for_server(20)
        return client

    return connect


def test_a_goal_cancelled_while_it_waits_leaves_the_queue(goals: Callable[[], Any]) -> None:
    go, began = Event(), list[str]()

    def answer(request: Request, _trace: Trace) -> Generator[Token, None, None]:
        began.append(request.id)
        yield Token(0, "a")
        go.wait(30)
        yield Token(1, "a")

    queued = Queued.around(answer)
    with serving(queued, "ros/action"):
        client = goals()
        first = client.send(client.pack(generate_goal("go", [])))
        until(lambda: began == [first.hex()])
        second = client.send(client.pack(generate_goal("go", [])))
        next_of(client, Accepted)
        until(lambda: queued.turns.waiting == 1)
        client.cancel(second)
        result = next_of(client, Result)
        assert (result.goal_id, result.status) == (second, Status.CANCELED)
        until(lambda: queued.turns.waiting == 0)
        client.cancel(first)
        go.set()
        assert next_of(client, Result).goal_id == first
        assert began == [first.hex()]


def test_the_name_of_a_request_on_the_topic_cannot_be_guessed(stranger: Middleware) -> None:
    handler = RecordingHandler(["x"])
    with serving(handler, "ros/topic") as address:
        heard = stranger.subscription(NAMESPACE + "/request", ros.REQUEST, READER_QOS)
        client = open_client(wiring_of("ros/topic", address))
        until(lambda: bool(heard.matched()))
        for _ in range(2):
            ask(client, Request("cell-1", "go"))
        client.close()
        names = [heard.unpack(heard.take(20)).id for _ in range(2)]
    assert names[0] != names[1]
    assert all(len(name) == len("cell-1#") + 32 for name in names)
    assert [request.id for request in handler.requests] == ["cell-1", "cell-1"]


def test_a_goal_has_no_more_tokens_than_the_limit(goals: Callable[[], Any]) -> None:
    small = Limits(answer_tokens=3)
    with serving(engine_handler(open_engine(EngineConfig(name="echo")), limits=small), "ros/action", small):
        client = goals()
        client.send(client.pack(generate_goal("a b c d e f", [])))
        assert client.unpack_result(next_of(client, Result).packed).response.text.split() == ["a", "b", "c"]
        assert not isinstance(client.next_event(0.1), Feedback)


def test_the_threads_of_ros_requests_that_waited_end() -> None:
    go = Event()

    def answer(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        go.wait(30)
        yield Token(0, "a")

    queued = Queued.around(answer)
    with serving(queued, "ros/topic") as address:
        middleware = join(wiring_of("ros/topic", address), "crowd")
        publisher = middleware.publisher(address + "/request", ros.REQUEST, QoS(depth=0))
        until(lambda: bool(publisher.matched()))
        for index in range(30):
            publisher.send(publisher.pack(request_message(Request(str(index), "a", max_tokens=1))))
        until(lambda: queued.turns.waiting == 29)
        most = active_count()
        go.set()
        until(lambda: active_count() <= most - 28)
        middleware.close()
