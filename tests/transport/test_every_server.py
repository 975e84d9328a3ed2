"""What the server core promises, over every transport: turns, deadlines, bounds, access, and who fails with whom."""

from __future__ import annotations

import re
import socket
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from threading import Event, Thread, get_ident
from typing import Protocol

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import PortInUse, RequestFailed, TransportError, UsageError
from s2a_bench.plugins.two_hosts.clocks import Exchange
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import RESIDUAL, Trace, budget
from s2a_bench.transport import ACTIONS, TOKENS, Client, Handler, open_client, open_server, risks
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.serving import CLOCK_PROMPT, Queued
from s2a_bench.types import Action, Piece, Request, Token
from tests.waiting import until

HTTP = ("http/as-deployed", "http/best-effort")
POLICIES = ("websocket/openpi", "websocket/openpi-stream", "zmq/gr00t")
EVERY = (*HTTP, "ros/topic", "ros/action", "iceoryx2", *POLICIES[::2])
"""One variant of each server."""
STREAMED = (*HTTP, "ros/action", "iceoryx2", "websocket/openpi-stream")
"""Those whose client notices each piece, and whose server notices that a client has gone."""
ON_PORTS = (*HTTP, "websocket/openpi", "zmq/gr00t")

every = pytest.mark.parametrize("name", EVERY)
on_ports = pytest.mark.parametrize("name", ON_PORTS)


class Gate:
    """A handler of so many pieces that waits after the first until it is let, and notes what began and ended."""

    def __init__(self, name: str, pieces: int = 2) -> None:
        self._acts = name in POLICIES
        self._pieces = pieces
        self.go = Event()
        self.began: list[str] = []
        self.ended: list[str] = []
        self.threads: set[int] = set()

    def __call__(self, request: Request, trace: Trace) -> Generator[Piece, None, None]:
        self.began.append(request.prompt)
        trace.mark("inference")
        try:
            for index in range(self._pieces):
                self.threads.add(get_ident())
                trace.token_ns[:] = [now_ns()] * (index + 1 if index < 2 else 1)
                yield Action(index, np.zeros(2, np.float32)) if self._acts else Token(index, "a")
                assert self.go.wait(20)
                Event().wait(0.001)
        finally:
            self.threads.add(get_ident())
            self.ended.append(request.prompt)


def recorder(name: str, pieces: int = 3) -> RecordingHandler:
    return RecordingHandler([[place / 8] for place in range(pieces)] if name in POLICIES else ["go "] * pieces)


class Connect(Protocol):
    def __call__(self, timeout_s: float = 20) -> Client: ...


@contextmanager
def serving(name: str, handler: Handler, **limits: float) -> Iterator[Connect]:
    """Serve within limits; yields what connects another client, of this patience, which is closed in the end."""
    wiring = replace(wiring_of(name), limits=Limits(**limits))
    with served(wiring, handler) as (server, _):
        clients: list[Client] = []

        def connect(timeout_s: float = 20) -> Client:
            clients.append(open_client(wiring_of(name, server.address, timeout_s=timeout_s)))
            return clients[-1]

        try:
            yield connect
        finally:
            for client in clients:
                client.close()


class Asking:
    """A request on a thread of its own, and what came of it."""

    def __init__(self, client: Client, prompt: str) -> None:
        self.trace = Trace()
        self.pieces: list[Piece] = []
        self.error = ""
        self._client, self._request = client, Request(prompt, prompt)
        self._thread = Thread(target=self._ask)
        self._thread.start()

    def _ask(self) -> None:
        try:
            self.pieces, self.trace = ask(self._client, self._request)
        except TransportError as error:
            self.error = str(error)

    def end(self) -> Asking:
        self._thread.join(30)
        assert not self._thread.is_alive()
        return self


@every
def test_one_that_waits_is_answered_in_its_turn_and_says_so(name: str) -> None:
    gate = Gate(name)
    queued = Queued.around(gate)
    with serving(name, queued) as connect:
        first = Asking(connect(), "first")
        until(lambda: gate.began)
        others = []
        for number in (1, 2):
            others.append(Asking(connect(), f"other {number}"))
            until(lambda number=number: queued.turns.waiting == number)  # type: ignore[misc]  # bound at once
        gate.go.set()
        assert [len(asking.end().pieces) for asking in (first, *others)] == [2, 2, 2]
    assert gate.began == gate.ended == ["first", "other 1", "other 2"]
    assert "queue" not in budget(first.trace.chain()).stages_ns
    assert all(budget(asking.trace.chain()).stages_ns["queue"] > 0 for asking in others)


@every
def test_a_client_that_compares_clocks_is_answered_in_its_turn_without_the_engine(name: str) -> None:
    handler = recorder(name)
    kind = ACTIONS if name in POLICIES else TOKENS
    with serving(name, handler) as connect:
        pieces, trace = ask(connect(), Request("clock", CLOCK_PROMPT + kind, max_tokens=1))
    assert len(pieces) == 1
    assert not handler.requests
    exchange = Exchange.of(trace)
    assert exchange.sent_ns <= exchange.received_ns <= exchange.answered_ns <= exchange.seen_ns


@every
def test_what_is_parsed_after_the_pictures_is_of_the_stage_of_parsing(name: str) -> None:
    with serving(name, recorder(name)) as connect:
        _, trace = ask(connect(), Request("a", "plan", (yuyv_frame(),), max_tokens=3, state=(0.5,) * 6))
    assert trace.remote is not None
    stages = [stage for stage, _ in trace.remote.marks if stage != "accept"]  # a goal's, once it is read
    *_, last, _ = stages[: len(stages) - stages[::-1].index(RESIDUAL)]
    assert one_pipeline(name).transport.stages[last] == "parse"


@every
def test_one_too_many_is_refused_at_once(name: str, caplog: pytest.LogCaptureFixture) -> None:
    gate = Gate(name)
    with serving(name, gate, waiting=0) as connect:
        first = Asking(connect(), "first")
        until(lambda: gate.began)
        with pytest.raises(RequestFailed, match=r"0 requests are waiting for the engine|rejected the goal") as busy:
            ask(connect(), Request("b", "second"))
        assert busy.value.retry_after_s == (1.0 if name in (*HTTP, "zmq/gr00t") else None)  # where it has a field
        gate.go.set()
        assert len(first.end().pieces) == 2
    assert gate.began == ["first"]
    logged = [line for line in caplog.messages if "0 requests are waiting for the engine already" in line]
    assert len(logged) == name.startswith("ros/")  # where a rejected goal hears no reason


@pytest.mark.parametrize("name", [name for name in EVERY if not name.startswith(("ros/", "zmq/"))])
def test_one_that_goes_while_it_waits_gives_its_place_up_and_never_begins(name: str) -> None:
    gate = Gate(name)
    queued = Queued.around(gate, Limits(waiting=1))
    with serving(name, queued) as connect:
        first = Asking(connect(), "first")
        until(lambda: gate.began)
        gone = connect(timeout_s=0.5)
        assert Asking(gone, "gone").end().error
        gone.close()
        until(lambda: queued.turns.waiting == 0)
        gate.go.set()
        assert len(first.end().pieces) == 2
        assert len(ask(connect(), Request("b", "last"))[0]) == 2
    assert gate.began == ["first", "last"]


@every
def test_one_that_waits_to_its_deadline_is_told_and_never_begins(name: str) -> None:
    gate = Gate(name)
    with serving(name, gate, answer_s=0.2) as connect:
        first = Asking(connect(), "first")
        until(lambda: gate.began)
        with pytest.raises(RequestFailed, match="is still waiting for the engine"):
            ask(connect(), Request("b", "second"))
        gate.go.set()
        first.end()
        until(lambda: gate.ended)
    assert gate.began == ["first"]


@pytest.mark.parametrize("name", ["loopback", *EVERY])
def test_an_answer_ends_at_its_deadline_and_the_next_one_begins(name: str) -> None:
    gate = Gate(name, 10**9)
    gate.go.set()
    with serving(name, Queued.around(gate, Limits(answer_s=0.2)), answer_s=0.2) as connect:
        client = connect()
        for turn in (1, 2):
            with pytest.raises(RequestFailed, match=r"0\.2 s after its arrival the request is still being answered"):
                ask(client, Request("a", "for ever", max_tokens=60_000))
            until(lambda turn=turn: len(gate.ended) == turn)  # type: ignore[misc]  # bound at once


@pytest.mark.parametrize("name", STREAMED)
def test_an_answer_whose_client_has_gone_ends(name: str) -> None:
    gate = Gate(name, 10**9)
    gate.go.set()
    with serving(name, gate) as connect:
        client = connect()
        next(iter(client.request(Request("a", "for ever", max_tokens=60_000), Trace())))
        client.close()
        until(lambda: gate.ended)
    assert len(gate.threads) == 1  # its own: the end may wait for the engine


@pytest.mark.parametrize("name", ["http/as-deployed", "http/best-effort", "iceoryx2"])
def test_a_client_that_does_not_read_does_not_keep_the_engine(name: str) -> None:
    many = 20_000
    with serving(name, RecordingHandler(["long " * 100] * many)) as connect:
        slow = connect().request(Request("slow", "go", max_tokens=many), Trace())
        next(iter(slow))
        assert len(ask(connect(), Request("b", "go", max_tokens=many))[0]) == many
        assert len([*slow]) == many - 1


@on_ports
def test_clients_at_once_are_all_answered(name: str) -> None:
    handler = recorder(name)
    with serving(name, handler) as connect:
        clients = [connect() for _ in range(4)]
        for _ in range(2):
            askings = [Asking(client, "go") for client in clients]
            assert [(asking.end().error, len(asking.pieces)) for asking in askings] == [("", 3)] * 4
    assert len(handler.requests) == 8


@every
def test_what_breaks_inside_is_not_shown_and_fails_this_request_only(name: str) -> None:
    fine = recorder(name)

    def handler(request: Request, trace: Trace) -> Generator[Piece, None, None]:
        if request.prompt == "break":
            raise KeyError("/home/secret")
        yield from fine(request, trace)

    with serving(name, handler) as connect:
        client = connect()
        for _ in range(3):
            with pytest.raises(RequestFailed, match="internal error; the server's log has it") as failed:
                ask(client, Request("a", "break"))
            assert "secret" not in str(failed.value)
        assert len(ask(client, Request("b", "go"))[0]) == 3


@every
def test_a_server_that_stops_ends_the_answer_under_way(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    gate = Gate(name, 10**9)
    server = open_server(wiring_of(name), gate)
    thread = Thread(target=server.serve)
    thread.start()
    with closing(open_client(wiring_of(name, server.address), thread.is_alive)) as client:
        asking = Asking(client, "for ever")
        until(lambda: gate.began)
        gate.go.set()
        server.stop()
        thread.join(30)
        assert not thread.is_alive()
        assert asking.end().error
    assert "Traceback" not in capsys.readouterr().err


WITH_LIMITS = [
    *((name, {"in_flight_mib": 0.03}, "under way already|rejected the goal") for name in EVERY),
    *((name, {"body_mib": 0.03}, "bytes") for name in (*HTTP, "ros/topic", "websocket/openpi")),
    *((name, {"pixels": 1000}, "320x240; at most 1000 pixels") for name in ("http/binary", *EVERY)),
]


@pytest.mark.parametrize(("name", "limits", "says"), WITH_LIMITS)
def test_a_picture_beyond_a_limit_is_refused_and_the_next_request_is_answered(
    name: str, limits: dict[str, float], says: str
) -> None:
    with serving(name, recorder(name), **limits) as connect:
        client = connect()
        for _ in range(3):
            with pytest.raises(RequestFailed, match=says):
                ask(client, Request("a", "go", (yuyv_frame(320, 240),)))
        assert len(ask(client, Request("b", "go"))[0]) == 3


@pytest.mark.parametrize("name", [*HTTP, "iceoryx2", "websocket/openpi"])
def test_a_connection_too_many_is_refused(name: str) -> None:
    with serving(name, recorder(name), connections=1) as connect:
        first = connect()
        ask(first, Request("a", "go"))
        with pytest.raises(
            RequestFailed, match=r"1 connections are open already|takes no further client|503: Service Unavailable"
        ):
            ask(connect(), Request("b", "go"))

        def answered(client: Client | None) -> bool:
            with suppress(RequestFailed):  # uvicorn counts a refused connection until it is closed
                return len(ask(client or connect(), Request("c", "go"))[0]) == 3
            return False

        until(lambda: answered(first))
        first.close()
        until(lambda: answered(None))


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.skipif(not has_ipv6(), reason="no IPv6 here")
@on_ports
def test_ipv6s_loopback_needs_no_key_and_has_brackets_in_urls(name: str) -> None:
    with served(wiring_of(name, f"::1:{wiring_of(name).options.port}"), recorder(name)) as (server, _):
        assert re.fullmatch(r"\w+://\[::1\]:[1-9]\d*", server.address)
        with closing(open_client(wiring_of(name, server.address))) as client:
            assert len(ask(client, Request("a", "go"))[0]) == 3
        assert ("state", "::1 answers") in {(each.level, each.message) for each in risks.examine(server.address)}
        with pytest.raises(PortInUse, match=r"`port`: \d+ is in use on ::1"):
            open_server(wiring_of(name, server.address.partition("//")[2]), recorder(name))
    with pytest.raises(UsageError, match="`host`: others reach ::; "):
        open_server(wiring_of(name, ":::0"), recorder(name))


@on_ports
def test_an_address_of_another_machine_and_a_port_in_use_are_named(name: str) -> None:
    for host in ("192.0.2.1", "no.such.host.invalid"):
        with pytest.raises(TransportError, match=rf"`host`: .*{host}"):
            open_server(wiring_of(name, f"{host}:0", no_auth=True), recorder(name))
    with (
        served(wiring_of(name), recorder(name)) as (server, _),
        pytest.raises(PortInUse, match=r"`port`: \d+ is in use"),
    ):
        open_server(wiring_of(name, server.address.partition("//")[2]), recorder(name))
