"""An answer that is slow but alive ends at its deadline with one clear error, and the engine is free afterwards."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Thread

import httpx
import pytest

from s2a_bench.errors import BadRequest, Overdue, RequestFailed
from s2a_bench.harness.serving import engine_handler
from s2a_bench.testing.transport import ask, wiring
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http.own import PATHS
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.turns import Turns
from s2a_bench.types import Request, Token
from tests.hostile.test_queue import CHAT, Gate, body, serving, until

SOON = Limits(answer_s=1.0)
REASON = "1 s after it came the request is still being answered"
NAMES = ["loopback", "http/as-deployed", "http/best-effort", "http/binary", "ros/topic", "ros/action", "shm"]


class Endless:
    """An engine whose answer to "for ever" does not end, and that cannot read a grammar."""

    def __init__(self) -> None:
        self.facts: dict[str, float] = {}
        self.closed = 0

    def generate(self, request: Request) -> Iterator[Token]:
        if request.grammar:
            raise BadRequest(f"the grammar of request {request.id} is not valid GBNF: it is none")
        try:
            for index in range(10**6 if request.prompt == "for ever" else 2):
                yield Token(index, "a")
                time.sleep(0.01)
        finally:
            self.closed += 1

    def describe(self) -> dict[str, str | int | float | bool]:
        return {}

    def close(self) -> None:
        pass


@pytest.mark.parametrize("name", NAMES)
def test_an_answer_ends_at_its_deadline_and_the_next_one_begins(name: str) -> None:
    engine = Endless()
    with serving(engine_handler(engine, pixels=False, limits=SOON), name, SOON) as address:
        client = open_client(wiring(name, address))
        try:
            with pytest.raises(RequestFailed, match=REASON):
                ask(client, Request("a", "for ever", max_tokens=60_000))
            assert engine.closed == 1
            assert len(ask(client, Request("b", "short", max_tokens=2))[0]) == 2
        finally:
            client.close()


def test_an_answer_that_is_not_streamed_is_504() -> None:
    with serving(engine_handler(Endless(), limits=SOON), limits=SOON) as url:
        answer = httpx.post(url + CHAT, json=body("for ever", stream=False, max_tokens=60_000), timeout=30)
        assert answer.status_code == 504
        assert REASON in answer.json()["error"]["message"]


def test_a_request_waits_no_longer_than_to_its_deadline() -> None:
    turns = Turns(Limits(answer_s=0.05))
    turns.join()
    with pytest.raises(Overdue, match="is still waiting for the engine"):
        turns.join().wait()


@pytest.mark.parametrize("name", ["http/as-deployed", "ros/topic", "ros/action", "shm"])
def test_one_that_waited_to_its_deadline_is_told_and_never_begins(name: str) -> None:
    gate = Gate()
    with serving(gate, name, SOON) as address:
        clients = [open_client(wiring(name, address)) for _ in range(2)]
        first = Thread(target=_left_alone, args=(clients[0].request(Request("first", "a"), Trace()),))
        first.start()
        until(lambda: len(gate.began) == 1)
        with pytest.raises(RequestFailed, match="is still waiting for the engine"):
            ask(clients[1], Request("second", "a"))
        gate.go.set()
        first.join(20)
        for client in clients:
            client.close()
        until(lambda: len(gate.ended) == 1)
        assert len(gate.began) == 1


def _left_alone(tokens: Iterator[Token]) -> None:
    """Read an answer that is expected to be given up."""
    with pytest.raises(RequestFailed):
        list(tokens)


@pytest.mark.parametrize("variant", list(PATHS))
def test_a_grammar_that_is_none_is_the_client_s_mistake(variant: str) -> None:
    with serving(engine_handler(Endless())) as url:
        if variant == "binary":
            answer = httpx.post(url + PATHS[variant], headers={"s2a-request": '{"grammar": "x"}'})
        else:
            answer = httpx.post(url + PATHS[variant], json=body(grammar="x"))
        assert answer.status_code == 400
        assert "not valid GBNF" in answer.json()["error"]["message"]


@pytest.mark.parametrize("name", ["ros/topic", "ros/action"])
def test_over_ros_it_is_told_too(name: str) -> None:
    with serving(engine_handler(Endless()), name) as address:
        client = open_client(wiring(name, address))
        try:
            with pytest.raises(RequestFailed, match="not valid GBNF"):
                ask(client, Request("a", "a", grammar="x"))
            assert len(ask(client, Request("b", "a", max_tokens=2))[0]) == 2
        finally:
            client.close()
