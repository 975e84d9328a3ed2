"""What every middleware's actions promise, as one suite.

Client and server are driven by turns on the test's own thread: both pull.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
import pytest

from s2a_bench.errors import TransportError
from s2a_bench.ros import (
    Accepted,
    ActionClient,
    ActionEvent,
    ActionServer,
    Feedback,
    Middleware,
    Rejected,
    Result,
    ServerGoal,
    llama,
)
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import ALL_GOALS, CANCEL_GOAL, CancelCode, Status
from s2a_bench.types import Frame
from tests.ros.middleware_suite import WAIT_S, Join, check_interrupt, until

Event = TypeVar("Event", bound=ActionEvent)
NAME = "/llama/generate_response"
CANCEL = NAME + "/_action/cancel_goal"


class Action(NamedTuple):
    client: ActionClient
    server: ActionServer
    serving: Middleware


def offer(join: Join, result_timeout_s: float = 60) -> Action:
    """Return a client and a server of two participants, matched."""
    serving = join()
    server = serving.action_server(NAME, llama.GENERATE_RESPONSE, result_timeout_s)
    client = join().action_client(NAME, llama.GENERATE_RESPONSE)
    assert client.wait_for_server(WAIT_S)
    return Action(client, server, serving)


def send(client: ActionClient, prompt: str = "p", goal_id: bytes | None = None) -> bytes:
    return client.send(client.pack(llama.generate_goal(prompt)), goal_id)


def receive(server: ActionServer) -> ServerGoal:
    goal = server.next_goal(WAIT_S)
    assert goal is not None
    return goal


def event(client: ActionClient, kind: type[Event]) -> Event:
    """The next event, which must be of this kind."""
    got = client.next_event(WAIT_S)
    assert isinstance(got, kind)
    return got


def start(action: Action, prompt: str = "p") -> ServerGoal:
    """Send, accept and start a goal."""
    sent = send(action.client, prompt)
    goal = receive(action.server)
    goal.accept()
    assert goal.id == sent == event(action.client, Accepted).goal_id
    assert goal.executing()
    return goal


def cancel(peer: Middleware, goal_id: bytes) -> tuple[int, set[bytes]]:
    """Cancel as any ROS program may; return the answer's code, and the goals that are being cancelled."""
    request = ros.default(CANCEL_GOAL + "_Request")
    request.goal_info.goal_id.uuid[:] = memoryview(goal_id)
    response = peer.service_client(CANCEL, CANCEL_GOAL).call(request, WAIT_S)
    return response.return_code, {bytes(info.goal_id.uuid) for info in response.goals_canceling}


def text_of(client: ActionClient, got: Feedback) -> str:
    return str(client.unpack_feedback(got.packed).partial_response.text)


class ActionSuite:
    """What every middleware's action clients and servers do.

    Fixture: ``join``, which opens one more participant of the same domain and closes all when the test ends.
    """

    @pytest.fixture
    def action(self, join: Join) -> Action:
        return offer(join)

    def test_a_goal_is_accepted_answered_token_by_token_and_ends_with_its_result(self, action: Action) -> None:
        client = action.client
        goal = start(action, "Wohin?")
        assert goal.unpack().prompt == "Wohin?"
        for number, text in enumerate(["go", "_to", "(Küche)"]):
            goal.feedback(llama.token_feedback(text, number))
        goal.succeed(llama.text_result("go_to(Küche)", [0, 1, 2]))
        feedback = [event(client, Feedback) for _ in range(3)]
        assert [text_of(client, got) for got in feedback] == ["go", "_to", "(Küche)"]
        result = event(client, Result)
        assert {*(got.goal_id for got in feedback), result.goal_id} == {goal.id}
        assert result.status == Status.SUCCEEDED
        response = client.unpack_result(result.packed).response
        assert (response.text, response.tokens.tolist()) == ("go_to(Küche)", [0, 1, 2])

    def test_a_rejected_goal_says_so_and_no_more(self, action: Action) -> None:
        sent = send(action.client)
        receive(action.server).reject()
        assert event(action.client, Rejected).goal_id == sent
        assert action.client.next_event(0.05) is None

    def test_a_goal_is_decided_once(self, action: Action) -> None:
        send(action.client)
        goal = receive(action.server)
        goal.reject()
        with pytest.raises(TransportError, match="accepted or rejected already"):
            goal.accept()

    def test_a_taken_goal_id_is_rejected(self, action: Action) -> None:
        goal = start(action)
        send(action.client, goal_id=goal.id)
        offered: list[ServerGoal | None] = []
        until(
            lambda: action.client.next_event(0) == Rejected(goal.id),
            lambda: offered.append(action.server.next_goal(0.02)),
        )
        assert not any(offered)

    def test_a_burst_of_a_thousand_tokens_arrives_whole_and_in_order(self, action: Action) -> None:
        client = action.client
        goal = start(action)
        tokens = [f"t{number} " for number in range(1000)]
        for number, text in enumerate(tokens):
            goal.feedback(llama.token_feedback(text, number))
        goal.succeed(llama.text_result("".join(tokens)))
        assert [text_of(client, event(client, Feedback)) for _ in tokens] == tokens
        assert client.unpack_result(event(client, Result).packed).response.text == "".join(tokens)

    def test_an_aborted_goal_says_so(self, action: Action) -> None:
        start(action).abort(llama.text_result("as far as it went"))
        assert event(action.client, Result).status == Status.ABORTED

    def test_a_goal_is_cancelled_in_mid_stream(self, action: Action) -> None:
        client = action.client
        goal = start(action)
        goal.feedback(llama.token_feedback("part", 0))
        event(client, Feedback)
        assert goal.cancel_requested is False
        client.cancel(goal.id)
        until(lambda: goal.cancel_requested)
        goal.canceled(llama.text_result("part"))
        result = event(client, Result)
        assert result.status == Status.CANCELED
        assert client.unpack_result(result.packed).response.text == "part"

    def test_a_goal_cancelled_while_it_queues_does_not_start(self, action: Action) -> None:
        sent = send(action.client)
        goal = receive(action.server)
        goal.accept()
        event(action.client, Accepted)
        action.client.cancel(sent)
        until(lambda: goal.cancel_requested)
        assert not goal.executing()
        goal.canceled(llama.text_result(""))
        assert event(action.client, Result).status == Status.CANCELED

    def test_cancelling_what_has_ended_or_never_was_is_refused(self, action: Action, join: Join) -> None:
        goal = start(action)
        goal.succeed(llama.text_result("x"))
        event(action.client, Result)
        assert cancel(join(), goal.id) == (CancelCode.GOAL_TERMINATED, set())
        assert cancel(join(), bytes(range(16))) == (CancelCode.UNKNOWN_GOAL_ID, set())

    def test_all_goals_are_cancelled_at_once(self, action: Action, join: Join) -> None:
        goals = [start(action), start(action)]
        assert cancel(join(), ALL_GOALS) == (CancelCode.NONE, {goal.id for goal in goals})
        assert all(goal.cancel_requested for goal in goals)

    def test_two_clients_get_only_their_own(self, action: Action, join: Join) -> None:
        other = join().action_client(NAME, llama.GENERATE_RESPONSE)
        assert other.wait_for_server(WAIT_S)
        sent = {send(client): client for client in (action.client, other)}
        goals = [receive(action.server) for _ in sent]
        for goal in goals:
            goal.accept()
            goal.executing()
        for goal in goals:
            goal.feedback(llama.token_feedback(goal.id.hex(), 0))
            goal.succeed(llama.text_result(goal.id.hex()))
        for goal_id, client in sent.items():
            assert event(client, Accepted).goal_id == goal_id
            assert text_of(client, event(client, Feedback)) == goal_id.hex()
            assert client.unpack_result(event(client, Result).packed).response.text == goal_id.hex()
            assert client.next_event(0.05) is None

    def test_the_result_of_an_unknown_goal_is_empty_with_status_0(self, action: Action) -> None:
        action.client.get_result(bytes(range(16)))
        result = event(action.client, Result)
        assert (result.goal_id, result.status) == (bytes(range(16)), Status.UNKNOWN)
        assert action.client.unpack_result(result.packed).response.text == ""

    def test_a_result_can_be_asked_for_again_until_it_expires(self, join: Join) -> None:
        action = offer(join, result_timeout_s=0.5)
        goal = start(action)
        goal.succeed(llama.text_result("x"))
        seen = [event(action.client, Result).status]

        def again() -> None:
            action.client.get_result(goal.id)
            seen.append(event(action.client, Result).status)
            action.client.next_event(0.05)

        until(lambda: seen[-1] == Status.UNKNOWN, again)
        assert set(seen) == {Status.SUCCEEDED, Status.UNKNOWN}

    def test_an_image_arrives_in_a_goal_unchanged(self, action: Action) -> None:
        pixels = np.random.default_rng(1).integers(0, 256, (480, 640, 3), np.uint8)
        image = ros.image_message(Frame(0, 0, 640, 480, "bgr8", pixels), 7, "camera")
        action.client.send(action.client.pack(llama.generate_goal("p", [image], grammar="root ::= x", stop=["</s>"])))
        goal = receive(action.server).unpack()
        (got,) = llama.goal_images(goal)
        np.testing.assert_array_equal(ros.frame_of_image(got).data, pixels)
        assert (goal.sampling_config.grammar, goal.stop) == ("root ::= x", ["</s>"])

    def test_a_server_that_left_is_missed(self, action: Action) -> None:
        assert action.client.server_present()
        start(action)
        action.serving.close()
        until(lambda: not action.client.server_present(), lambda: action.client.next_event(0.01))
        assert not action.client.wait_for_server(0.01)

    def test_a_client_that_left_harms_nobody(self, action: Action, join: Join) -> None:
        leaving = join()
        other = leaving.action_client(NAME, llama.GENERATE_RESPONSE)
        assert other.wait_for_server(WAIT_S)
        send(other)
        goal = receive(action.server)
        leaving.close()
        goal.accept()
        goal.executing()
        goal.succeed(llama.text_result("nobody hears"))
        start(action).succeed(llama.text_result("x"))
        assert event(action.client, Result).status == Status.SUCCEEDED

    @pytest.mark.parametrize("side", ["client", "server"])
    def test_an_interrupt_ends_a_blocked_wait_and_later_ones(self, action: Action, side: str) -> None:
        end: Any = getattr(action, side)
        check_interrupt(end, end.next_event if side == "client" else end.next_goal)
