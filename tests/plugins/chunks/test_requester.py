"""Requests of a control loop: the actions of answers that fail, and when a request is repeated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import RequestPlan, resolve
from s2a_bench.harness.session import Measured, Place, RequestContext, Session
from s2a_bench.plugins.chunks.requester import ChunkRequester, Job
from s2a_bench.types import Action, Vector


@dataclass
class Server:
    """A session with answers of given lengths and errors."""

    answers: list[tuple[int, str]]
    """Actions, and the error."""
    places: list[Place] = field(default_factory=list)
    cell: Any = field(default_factory=lambda: SimpleNamespace(name="fake"))
    request: RequestPlan = field(default_factory=lambda: resolve(RequestsConfig(transports="loopback")).request)

    def measure(self, place: Place, context: RequestContext) -> Measured:
        self.places.append(place)
        actions, error = self.answers[len(self.places) - 1]
        for index in range(actions):
            context.on_piece(Action(index, np.full(1, len(self.places), np.float32)), 100 * len(self.places) + index)
        sample: Any = SimpleNamespace(error=error, request_id=f"fake-{place.block}", payload_bytes=7)
        return Measured(sample, [], 0)


def send_request(
    *answers: tuple[int, str], streams: bool = False
) -> tuple[list[tuple[list[float], int]], ChunkRequester, Server]:
    """Send one request, and return the chunks so far with their times."""
    server = Server(list(answers))
    received: list[tuple[list[float], int]] = []

    def hear(_request: int, actions: Sequence[Vector], at_ns: int) -> None:
        received.append(([float(action[0]) for action in actions], at_ns))

    requester = ChunkRequester([cast("Session", server)], 3, 0, streams, hear, count())
    with requester.running():
        requester.jobs.put(Job(0, 0, ()))
        while requester.done.qsize() < len(answers) and requester.failure is None:
            pass
    return received, requester, server


def test_a_request_that_fails_is_made_again_and_its_chunk_is_that_of_one_answer() -> None:
    received, requester, server = send_request((2, "broken"), (3, ""))
    assert received == [([2.0] * 3, 202)]
    assert [place.position for place in server.places] == [0, 1]
    assert requester.done.qsize() == 2
    assert requester.sent_bytes == 14
    assert requester.names == {0: "fake-1"}


def test_of_a_second_answer_only_actions_count_that_had_not_come() -> None:
    received, _, _ = send_request((2, "broken"), (3, ""), streams=True)
    assert received == [([1.0], 100), ([1.0] * 2, 101), ([1.0, 1.0, 2.0], 202)]


@pytest.mark.parametrize("streams", [False, True])
def test_an_answer_that_fails_once_it_is_whole_is_not_asked_for_again(streams: bool) -> None:
    received, requester, server = send_request((3, "the marks were lost"), streams=streams)
    assert received[-1] == ([1.0] * 3, 102)
    assert len(server.places) == 1
    assert requester.failure is None


def test_a_chunk_of_another_length_fails_the_loop() -> None:
    _, requester, _ = send_request((2, ""))
    assert isinstance(requester.failure, UsageError)
