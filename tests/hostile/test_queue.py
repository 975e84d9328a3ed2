"""The queue in front of an engine: bounded, in the order of arrival, and never stuck."""

from __future__ import annotations

import socket
import time
from collections.abc import Generator
from contextlib import closing
from threading import Event
from typing import Any

import httpx
import pytest

from s2a_bench.errors import BadRequest, RequestFailed
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import Queued, Turns
from s2a_bench.types import Request, Token
from tests.transport.test_http import serving
from tests.waiting import until

CHAT, BEST_EFFORT = PATHS["as-deployed"], PATHS["best-effort"]
SERVERS = {CHAT: "http", BEST_EFFORT: "http/best-effort"}
paths = pytest.mark.parametrize("path", [CHAT, BEST_EFFORT])


def body(prompt: str = "go on", *, stream: bool = True, **more: Any) -> dict[str, Any]:
    return {"messages": [{"role": "user", "content": prompt}], "stream": stream, **more}


class Gate:
    """An answer that goes on for ever once `go` is set, and counts who came and who ended."""

    def __init__(self) -> None:
        self.go = Event()
        self.began: list[str] = []
        self.ended: list[str] = []

    def __call__(self, request: Request, _trace: Trace) -> Generator[Token, None, None]:
        self.began.append(request.id)
        try:
            for index in range(100_000):
                yield Token(index, "a")
                self.go.wait(30)
                time.sleep(0.001)
        finally:
            self.ended.append(request.id)


def test_leaving_twice_lets_one_run_not_two() -> None:
    turns = Turns()
    first, second, third = (turns.join() for _ in range(3))
    first.leave()
    first.leave()
    assert second.has_started
    assert not third.has_started


def ask_and_go(url: str, *, stream: bool, request_id: str, path: str = CHAT) -> socket.socket:
    """Send a request over a socket of its own, and do not read."""
    import json

    host, port = url.removeprefix("http://").split(":")
    data = json.dumps(body(stream=stream, request_id=request_id)).encode()
    kind = "Host: localhost\r\nContent-Type: application/json"
    head = f"POST {path} HTTP/1.1\r\n{kind}\r\nContent-Length: {len(data)}\r\n\r\n"
    connection = socket.create_connection((host, int(port)))
    connection.sendall(head.encode() + data)
    return connection


@paths
@pytest.mark.parametrize("stream", [True, False])
def test_a_token_that_cannot_be_sent_frees_the_engine(stream: bool, path: str) -> None:
    def surrogates(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        yield Token(0, "a")
        yield Token(1, "\ud800")

    queued = Queued.around(surrogates)
    with serving(queued, SERVERS[path]) as url:
        for _ in range(3):
            try:
                httpx.post(url + path, json=body(stream=stream), timeout=10)
            except httpx.RemoteProtocolError:
                assert stream  # broken off: its status was sent
        until(lambda: queued.turns.silent_s() == 0)


@paths
def test_health_says_when_the_engine_is_stuck(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.transport.serving.STUCK_S", 0.2)
    gate = Gate()
    with serving(gate, SERVERS[path]) as url:
        assert httpx.get(url + "/health").status_code == 200
        connection = ask_and_go(url, stream=True, request_id="a", path=path)
        until(lambda: httpx.get(url + "/health").status_code == 503)
        assert "no sign of life" in httpx.get(url + "/health").json()["reason"]
        gate.go.set()
        connection.close()
        until(lambda: httpx.get(url + "/health").status_code == 200)


@paths
def test_an_answer_that_is_not_streamed_is_504_at_its_deadline(path: str) -> None:
    gate = Gate()
    gate.go.set()
    with serving(gate, SERVERS[path], Limits(answer_s=1.0)) as url:
        answer = httpx.post(url + path, json=body("for ever", stream=False, max_tokens=60_000), timeout=30)
    assert answer.status_code == 504
    assert "1 s after its arrival the request is still being answered" in answer.json()["error"]["message"]


@pytest.mark.parametrize("name", [*(f"http/{variant}" for variant in PATHS), "ros/topic", "ros/action"])
def test_a_grammar_that_is_none_is_the_client_s_mistake(name: str) -> None:
    def answer(request: Request, _trace: Trace) -> Generator[Token, None, None]:
        if request.grammar:
            raise BadRequest("the grammar is not valid GBNF")
        yield Token(0, "a")

    says = "answered 400: .*not valid GBNF" if name.startswith("http") else "not valid GBNF"
    with serving(answer, name) as address, closing(open_client(wiring_of(name, address))) as client:
        with pytest.raises(RequestFailed, match=says):
            ask(client, Request("a", "a", grammar="x"))
        assert len(ask(client, Request("b", "a", max_tokens=2))[0]) == 1
