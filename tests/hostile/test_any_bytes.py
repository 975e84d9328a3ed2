"""Any bytes are answered or closed, and never a crash: a client's by our servers, a server's by our clients."""

from __future__ import annotations

import os
import re
import resource
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError
from s2a_bench.ros import messages, open_middleware
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring, open_client
from s2a_bench.transport.http import detect
from s2a_bench.transport.http.native import PATHS
from s2a_bench.transport.ros.wire import TOKEN_QOS, token_message
from s2a_bench.types import Request, Token
from tests.hostile.peers import (
    TOKENS,
    Case,
    Server,
    Target,
    answers,
    connect,
    forget_peak,
    normal_answer,
    own_server,
    sends,
    usage,
)
from tests.hostile.wires import http, iceoryx2, ros, websocket, zmq
from tests.servers.sockets import head
from tests.waiting import until

CLIENTS: dict[str, Sequence[Case]] = {
    "http": http.CLIENTS,
    "http/best-effort": http.FAST,
    "websocket/openpi": websocket.CLIENTS,
    "zmq/gr00t": zmq.CLIENTS,
    "iceoryx2": iceoryx2.CLIENTS,
    "ros/topic": ros.CLIENTS,
}
SERVERS: dict[str, Sequence[Server]] = {
    "http/as-deployed": http.SERVERS,
    "http/best-effort": http.SERVERS[:6],
    "websocket/openpi": websocket.SERVERS,
    "zmq/gr00t": zmq.SERVERS,
}
CLIENT_MIB = 128.0
"""The most memory that one answer costs a client."""
SCHEMES = {"http": "http://", "websocket": "ws://", "zmq": "tcp://"}


def cases(table: dict[str, Sequence[Any]]) -> Any:
    params = [(name, case) for name, each in table.items() for case in each]
    return pytest.mark.parametrize(("name", "case"), params, ids=[f"{name}, {case.name}" for name, case in params])


@cases(CLIENTS)
def test_a_client_is_answered_or_closed_and_the_next_one_is_served(
    targets: Callable[[str], Target], name: str, case: Case
) -> None:
    targets(name).meets(case)


def asking(name: str, address: str, timeout_s: float, deadline_s: float = 0) -> Wiring[Any]:
    """Return what a client is told of a server: over HTTP that it is not ours."""
    address = SCHEMES[name.partition("/")[0]] + address
    known: dict[str, Any] = {"url": address, "dialect": "openai", "served_model": "m"}
    options = known if name.startswith("http") else {"address": address}
    return wiring_of(name, **options, timeout_s=timeout_s, deadline_s=deadline_s, max_tokens=TOKENS)


@cases(SERVERS)
def test_a_server_costs_its_client_an_error_of_one_line_and_little_memory(name: str, case: Server) -> None:
    error, began = "", now_ns()
    with case.does() as address, closing(open_client(asking(name, address, case.timeout_s, case.deadline_s))) as client:
        forget_peak(os.getpid())
        before = usage(os.getpid()).rss_mib
        try:
            list(client.request(Request("a", "plan", max_tokens=TOKENS), Trace()))
        except S2AError as failure:
            error = f"{type(failure).__name__}: {failure}"
        assert usage(os.getpid()).peak_mib - before < CLIENT_MIB
    assert now_ns() - began < (case.timeout_s + 10) * 1e9
    assert re.search(case.says, error)
    assert error.isprintable()


def test_who_asks_what_a_server_is_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detect, "PATIENCE_S", 1.0)
    (endless,) = (server for server in http.SERVERS if server.name == "a refusal, slowly")
    with endless.does() as address, closing(open_client(wiring_of("http", url=f"http://{address}"))) as client:
        assert client.describe()["dialect"] == "openai"


@pytest.mark.parametrize("name", ["ros/topic", "ros/action"])
def test_ros_clients_have_the_same_deadline(name: str) -> None:
    left = Event()

    def talks(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        for index in count():
            yield Token(index, "go ")
            if left.wait(0.2):
                return

    with served(wiring_of(name, "/talks"), talks) as (server, _):
        wiring = wiring_of(name, server.address, deadline_s=1)
        with closing(open_client(wiring)) as client, pytest.raises(RequestFailed, match="within 1 s; see `deadline`"):
            list(client.request(Request("a", "plan", max_tokens=1), Trace()))
        left.set()


def test_a_server_that_counts_otherwise_is_not_cut() -> None:
    """A gateway may send letters, and what a model thinks beside."""
    thoughts, letters = http.delta(reasoning_content="h") * 999, http.delta(content="x") * 40
    trap = answers(head(), thoughts + letters + b"data: [DONE]\n\n", leaves=True)
    with trap() as address, closing(open_client(asking("http/as-deployed", address, 20))) as client:
        assert len(list(client.request(Request("a", "plan", max_tokens=TOKENS), Trace()))) == 40


@pytest.mark.parametrize(("name", "topic"), [("ros/topic", "/token"), ("ros/action", "/marks")])
def test_garbage_and_guesses_beside_an_answer_are_skipped_and_counted(dds_domain: int, name: str, topic: str) -> None:
    kind = {"/token": messages.TOKEN, "/marks": messages.MARKS}[topic]
    with ExitStack() as stack:
        server, _ = stack.enter_context(served(wiring_of(name, "/beside"), RecordingHandler(["go ", "on"])))
        client = stack.enter_context(closing(open_client(wiring_of(name, server.address))))
        stranger = stack.enter_context(closing(open_middleware(domain_id=dds_domain, node_name="/stranger")))
        publisher = stranger.publisher(server.address + topic, kind, TOKEN_QOS)
        until(lambda: bool(publisher.matched()))
        for garbage in (b"\xff" * 64, bytes(3), b"\x40\0\0\0" + b"a" * 8):
            publisher.send(bytearray(b"\0\1\0\0" + garbage))
        if name == "ros/topic":
            for guess in ("a", "a#", "a#" + "0" * 32):
                publisher.send(publisher.pack(token_message(guess, Token(0, "forged", 1), last=True, error="forged")))
        unreadable = 0.0
        while unreadable < 3:  # garbage may arrive after an answer
            tokens, trace = ask(client, Request("a", "go on"))
            assert "".join(token.text for token in tokens) == "go on"
            unreadable += trace.facts.get("unreadable_n", 0)
        assert unreadable == 3


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
def test_out_of_descriptors_those_that_are_connected_are_answered(variant: str, tmp_path: Path) -> None:
    wiring = wiring_of(f"http/{variant}")
    with own_server(wiring, tmp_path / "log") as server, ExitStack() as stack:
        bound = replace(wiring, address=server.address)
        client = stack.enter_context(closing(open_client(bound)))
        expected = normal_answer(client)
        limits = resource.prlimit(server.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (usage(server.pid).descriptors + 3, limits[1]))
        for _ in range(20):
            stack.enter_context(connect(bound))
        assert normal_answer(client) == expected
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, limits)
        chat = http.chat(PATHS[variant])
        assert sends(chat)(bound, "200").startswith("HTTP/1.1 200 ")
    assert "Traceback" not in (tmp_path / "log").read_text()
