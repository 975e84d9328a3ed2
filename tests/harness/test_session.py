"""A session: a server that asks to be left alone is left alone for a bounded time, and what its marks mean."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.clock import VirtualClock, clock_id
from s2a_bench.frames import open_source
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import back_off
from s2a_bench.harness.servers import ServerSet
from s2a_bench.harness.session import Place, Session, inference_start_ns
from s2a_bench.provenance import Provenance
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.types import Request, Token
from tests.servers.sockets import head, serving
from tests.servers.speakers import Cloud


def session_of(client: Any, cell: Any = "http/as-deployed", **more: Any) -> Session:
    """Return a session of a client whose pictures are made up."""
    cell = one_pipeline(cell) if isinstance(cell, str) else cell
    feed = RequestFeed(open_source("synthetic", 64, 48, fps=30.0, seed=0), preencoded=False)
    return Session(cell, client, feed, **{"request": resolve(RequestsConfig(), print).request, **more})


@pytest.mark.parametrize(("retry_after_s", "waited_s"), [(0.0, 0), (1.5, 1.5), (60.0, 60), (3600.0, 60)])
def test_the_wait_is_what_was_asked_up_to_a_minute(retry_after_s: float, waited_s: float) -> None:
    clock, lines = VirtualClock(5), []
    back_off("http/as-deployed", retry_after_s, clock, lines.append)
    assert clock.now_ns() - 5 == waited_s * 1e9
    assert lines == ([f"waiting {waited_s:g} s for the server of http/as-deployed"] if retry_after_s else [])


@pytest.mark.parametrize(("more", "retry_after_s"), [(["Retry-After: 7"], 7.0), ([], 0.0)])
def test_a_refused_sample_is_one_row_with_its_error_and_is_not_sent_again(
    more: list[str], retry_after_s: float
) -> None:
    requests = []

    def busy(received: object) -> list[bytes]:
        requests.append(received)
        return [head("429 Too Many Requests", "application/json", *more), Cloud().refusal(429, "slow down")]

    with serving(busy) as url:
        cell = one_pipeline("http/as-deployed", url=url, dialect="openai", served_model="m")
        client = open_client(cell.wiring(url))
        measured = session_of(client, cell).measure(Place(0, 0, warmup=False))
        client.close()
    assert measured.retry_after_s == retry_after_s
    assert "answered 429: slow down" in measured.sample.error
    assert (measured.fatal, measured.tokens, len(requests)) == (None, [], 1)


@pytest.mark.parametrize("inside", [["inference"], ["preprocess", "inference"]])
def test_inference_starts_where_the_engine_gets_the_request(inside: list[str]) -> None:
    trace = Trace()
    trace.marks = [(stage, 10 * place) for place, stage in enumerate(["", "capture", "queue", *inside, "return"])]
    assert inference_start_ns(trace) == 20


@pytest.mark.parametrize(
    ("transport", "address", "link"),
    [
        ("http/as-deployed", {"url": "http://127.0.0.1:1"}, "real"),
        ("websocket", {"url": "ws://localhost:1"}, "real"),
        ("http/as-deployed", {"url": "http://192.0.2.1:1"}, "unknown"),
        ("zmq", {"url": "tcp://192.0.2.1:1"}, "unknown"),
        ("ros/action", {"action": "/robot/answer"}, "unknown"),
    ],
)
def test_the_link_to_a_server_of_another_machine_is_unknown(
    transport: str, address: dict[str, str], link: str, tmp_path: Path
) -> None:
    cell = one_pipeline(transport, **address)
    with ExitStack() as stack:
        servers = ServerSet(replace(resolve(RequestsConfig(), print), cells=(cell,)), stack, tmp_path)
        servers.start()
        assert servers.origin(cell).link == link


def test_a_stage_that_its_transport_does_not_declare_makes_the_sample_an_error() -> None:
    class Greeting:
        def request(self, _: Request, trace: Trace) -> Iterator[Token]:
            trace.mark("greet")
            yield Token(0, "x")

    measured = session_of(Greeting(), "loopback").measure(Place(0, 0, warmup=False))
    assert measured.sample.error == "TransportError: loopback does not declare the stage greet"


HERE, ELSEWHERE = clock_id(), "another machine"


@pytest.mark.parametrize(
    ("before", "clock", "after"),
    [
        ("unknown", HERE, "real"),
        ("unknown", ELSEWHERE, "unknown"),
        ("real", HERE, "real"),
        ("real", ELSEWHERE, "unknown"),  # the end of a tunnel
        ("none", ELSEWHERE, "none"),
        ("emulated", HERE, "emulated"),
    ],
)
def test_the_clock_of_an_answer_tells_whether_the_link_leaves_this_machine(before: str, clock: str, after: str) -> None:
    class Answering:
        def request(self, _: Request, trace: Trace) -> Iterator[Token]:
            yield Token(0, "x")
            trace.receive(Remote(clock, provenance=Provenance("echo", link="real").to_dict()))

    session = session_of(Answering(), "loopback", origin=Provenance(link=before))
    session.measure(Place(0, 0, warmup=False))
    assert (session.origin.engine, session.origin.link) == ("echo", after)
