"""The ROS variant `action` beyond the contract: llama_ros nodes, limits, cancels, stop words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from threading import Event, Thread
from typing import Any, Protocol

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import MessagesLost, RequestFailed, ServerDied, TransportError
from s2a_bench.ros import ActionClient, Rejected, Result, ServerGoal, open_middleware
from s2a_bench.ros.action import ServedAction, Status
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal, goal_images, text_result, token_feedback
from s2a_bench.testing.transport import RecordingHandler, ask, connector, served, wiring_of, yuyv_frame
from s2a_bench.trace import budget
from s2a_bench.transport import Handler, Wiring, open_client, open_server
from s2a_bench.transport.serving import Queued
from s2a_bench.types import Request

NODE = "/llama_ros/generate_response"
Node = Callable[..., list[ServerGoal]]
Answer = Callable[[ServerGoal], object]
LEAVES = "leaves"
"""What a node answers that ends with its goal."""


@pytest.fixture
def foreign(dds_domain: int) -> Wiring[Any]:
    """A told to somebody else's node."""
    return wiring_of("ros/action", action=NODE, domain_id=dds_domain)


class Stranger(Protocol):
    def __call__(self, name: str, handler: Handler, version: str = ..., **more: Any) -> ActionClient: ...


@pytest.fixture
def stranger(dds_domain: int) -> Iterator[Stranger]:
    """Serve under a name, and connect the action client of another node, which speaks a version."""
    with ExitStack() as stack:

        def start(name: str, handler: Handler, version: str = "6.0", **more: Any) -> ActionClient:
            stack.enter_context(served(wiring_of("ros/action", name, domain_id=dds_domain, **more), handler))
            middleware = stack.enter_context(closing(open_middleware(domain_id=dds_domain)))
            client = middleware.action_client(name + "/generate_response", GENERATE_RESPONSE, version)
            assert client.wait_for_server(20)
            return client

        yield start


def end_of(client: ActionClient, goal: Any) -> Result | Rejected:
    """Send a goal; return how it ended."""
    client.send(client.pack(goal))
    while not isinstance(event := client.next_event(20), (Result, Rejected)):
        assert event is not None, "a goal never ended"
    return event


@pytest.fixture
def node(dds_domain: int) -> Iterator[Node]:
    """Run a node like llama_ros: it answers every goal with ten tokens, or as told."""
    with ExitStack() as stack:

        def start(version: str = "6.0", answer: Answer | None = None) -> list[ServerGoal]:
            middleware = open_middleware(domain_id=dds_domain, node_name="/llama_ros/llama_node")
            server = middleware.action_server(NODE, GENERATE_RESPONSE, version=version)
            goals: list[ServerGoal] = []
            left = Event()

            def serve() -> None:
                while (goal := server.next_goal(60)) is not None:
                    goals.append(goal)
                    if (answer or partial(ten_tokens, version=version))(goal) == LEAVES:
                        left.set()
                        middleware.close()
                        return

            thread = Thread(target=serve)
            thread.start()
            stack.callback(middleware.close)
            stack.callback(thread.join)
            stack.callback(lambda: left.is_set() or server.interrupt())
            return goals

        yield start


def ten_tokens(goal: ServerGoal, version: str) -> None:
    goal.accept()
    goal.executing()
    for number in range(10):
        if goal.cancel_requested:
            break
        goal.feedback(token_feedback(f"t{number} ", number, version))
    end = goal.canceled if goal.cancel_requested else goal.succeed
    end(text_result("whole", [1], version))


@pytest.mark.parametrize("version", ["6.0", "4.4"])
def test_a_llama_ros_node_is_driven_in_its_own_version(node: Node, foreign: Wiring[Any], version: str) -> None:
    goals = node(version)
    with closing(open_client(foreign)) as client:
        tokens, trace = ask(client, Request("a", "what is this?", (yuyv_frame(),), grammar='root ::= "x"'))
    assert [token.text for token in tokens] == [f"t{number} " for number in range(10)]
    goal = goals[0].unpack()
    assert goal.prompt == "<__media__>what is this?"
    assert goal.sampling_config.grammar == 'root ::= "x"'
    assert goal.sampling_config.top_k == 40
    (image,) = goal_images(goal)
    assert (image.encoding, image.width, image.height) == ("bgr8", 64, 48)
    stages = set(budget(trace.chain()).stages_ns)
    assert stages == {"convert", "cdr_pack", "server"}
    assert client.camera is None


def test_a_node_without_a_limit_is_cancelled_after_the_last_wanted_token(node: Node, foreign: Wiring[Any]) -> None:
    ended: list[int] = []

    def endless(goal: ServerGoal) -> None:
        goal.accept()
        goal.executing()
        for number in range(3):
            goal.feedback(token_feedback("x", number))
        deadline = now_ns() + 20_000_000_000
        while not goal.cancel_requested and now_ns() < deadline:
            Event().wait(0.001)
        goal.canceled(text_result("", []))
        ended.append(Status.CANCELED)

    node(answer=endless)
    with closing(open_client(foreign)) as client:
        tokens, _ = ask(client, Request("a", "plan", max_tokens=3))
    assert len(tokens) == 3
    assert ended == [Status.CANCELED]


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (lambda goal: goal.reject(), RequestFailed, "rejected the goal"),
        (
            lambda goal: (goal.accept(), goal.executing(), goal.abort(text_result("no memory"))),
            RequestFailed,
            "no memory",
        ),
        (lambda goal: (goal.accept(), goal.executing(), goal.abort(text_result(""))), RequestFailed, "with status 6"),
        (lambda goal: goal.accept() or LEAVES, ServerDied, "/llama_ros/generate_response has ended"),
    ],
)
def test_a_node_that_refuses_or_leaves_fails_the_request(
    node: Node, foreign: Wiring[Any], answer: Answer, error: type[Exception], message: str
) -> None:
    node(answer=answer)
    with closing(open_client(foreign)) as client, pytest.raises(error, match=message):
        ask(client, Request("a", "plan"))


def test_feedback_that_does_not_arrive_is_a_message_lost(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServedAction, "publish_feedback", lambda *_: None)
    with closing(connector(wiring_of("ros/action", "/test_lost", domain_id=dds_domain))) as connecting:
        client = next(connecting)(RecordingHandler(["go", "on"]))
        with pytest.raises(MessagesLost, match="of the answer's 4 letters 0 came as feedback"):
            ask(client, Request("a", "plan"))


def test_no_node_is_said_so(foreign: Wiring[Any]) -> None:
    with pytest.raises(ServerDied, match="no action server appeared at /llama_ros/generate_response"):
        open_client(foreign, lambda: False)


def test_our_server_heeds_what_a_goal_wants_of_sampling(stranger: Stranger) -> None:
    recorder = RecordingHandler(["one ", "two ", "three ", "four "])
    handler = Queued.around(recorder)
    handler.honours = ("temp",)
    client = stranger("/test_sampling", handler)
    ends = []
    for wish in ({"stop": ["three"]}, {"temp": 0.25, "top_k": 3}, {"temp": -1.0}):
        end = end_of(client, generate_goal("p", **wish))
        assert isinstance(end, Result)
        response = client.unpack_result(end.packed).response
        ends.append((end.status, response.text, list(response.tokens)))
    assert ends == [
        (Status.SUCCEEDED, "one two three ", [7, 8, 9]),
        (Status.SUCCEEDED, "one two three four ", [7, 8, 9, 10]),
        (Status.ABORTED, "sampling_config.temp: -1 is not 0 to 100", []),
    ]
    assert [(request.sampling, request.seed) for request in recorder.requests] == [((), 0), ((("temp", 0.25),), 0)]


def test_tokens_faster_than_the_interval_share_a_feedback_and_none_is_lost(dds_domain: int) -> None:
    words = [f"t{number} " for number in range(200)]
    wiring = wiring_of("ros/action", "/test_pace", domain_id=dds_domain, max_tokens=200, feedback_interval=0.02)
    with closing(connector(wiring)) as connecting:
        tokens, _ = ask(next(connecting)(RecordingHandler(words)), Request("a", "plan", max_tokens=200))
    assert "".join(token.text for token in tokens) == "".join(words)
    assert len(tokens) < 100


def test_a_goal_that_cannot_start_ends_and_says_why(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    execute = ServedAction.execute
    failures = [TransportError("no status can be sent")]

    def executing(server: ServedAction[Any], goal_id: bytes) -> bool:
        if failures:
            raise failures.pop()
        return execute(server, goal_id)

    monkeypatch.setattr(ServedAction, "execute", executing)
    wiring = wiring_of("ros/action", "/test_start", domain_id=dds_domain)
    with closing(connector(wiring)) as connecting:
        client = next(connecting)(RecordingHandler(["fine"]))
        with pytest.raises(RequestFailed, match="no status can be sent"):
            ask(client, Request("a", "plan"))
        assert len(ask(client, Request("a", "plan"))[0]) == 1


def test_our_server_does_not_join_a_node_that_answers_already(node: Node, dds_domain: int) -> None:
    node()
    with pytest.raises(TransportError, match="another server answers under /llama_ros"):
        open_server(wiring_of("ros/action", "/llama_ros", domain_id=dds_domain), RecordingHandler(["x"]))


@pytest.mark.parametrize(("spoken", "other"), [("4.4", "6.0"), ("6.0", "4.4")])
def test_our_server_speaks_the_version_it_is_told_and_logs_who_speaks_another(
    stranger: Stranger, dds_domain: int, caplog: pytest.LogCaptureFixture, spoken: str, other: str
) -> None:
    recorder = RecordingHandler(["a ", "b"])
    foreign = stranger("/s2a", recorder, other, llama_msgs=spoken)
    with closing(open_client(wiring_of("ros/action", "/s2a", domain_id=dds_domain))) as client:
        tokens, _ = ask(client, Request("a", "plan", (yuyv_frame(),), grammar='root ::= "x"'))
    assert [token.text for token in tokens] == ["a ", "b"]
    assert recorder.requests[0].grammar == 'root ::= "x"'
    assert isinstance(end_of(foreign, generate_goal("plan", version=other)), Rejected)
    assert f"rejected: its client speaks llama_msgs {other}, this server {spoken} (--llama-msgs)" in caplog.text
