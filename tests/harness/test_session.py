"""A session: a server that asks to be left alone is left alone for a bounded time, and what its marks mean."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.clock import SystemClock, VirtualClock, clock_id
from s2a_bench.errors import ClockMoved
from s2a_bench.frames import open_source
from s2a_bench.harness.clocks import Bounded, Exchange, Offset
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import back_off
from s2a_bench.harness.servers import ServerSet
from s2a_bench.harness.session import Measured, Place, Session, inference_start_ns
from s2a_bench.machine.clocks import WallClock
from s2a_bench.provenance import Provenance
from s2a_bench.store.requests import samples_table
from s2a_bench.trace import STAGES as COMMON
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.serving import CLOCK_PROMPT, REALTIME_ERROR_MS, REALTIME_MS
from s2a_bench.types import Request, Token
from tests.servers.sockets import head, serving
from tests.servers.speakers import Cloud


def session_of(client: Any, cell: Any = "http/as-deployed", **more: Any) -> Session:
    """Return a session of a client whose pictures are made up."""
    cell = one_pipeline(cell) if isinstance(cell, str) else cell
    feed = RequestFeed(open_source("synthetic", 64, 48, fps=30.0, seed=0), preencoded=False)
    return Session(cell, client, feed, **{"request": resolve(RequestsConfig()).request, **more})


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
        servers = ServerSet(replace(resolve(RequestsConfig()), cells=(cell,)), stack, tmp_path)
        servers.start()
        assert servers.origin(cell).link == link


def test_a_stage_that_its_transport_does_not_declare_makes_the_sample_an_error() -> None:
    class Greeting:
        def request(self, _: Request, trace: Trace) -> Iterator[Token]:
            trace.mark("greet")
            yield Token(0, "x")

    measured = session_of(Greeting(), "loopback").measure(Place(0, 0, warmup=False))
    assert measured.sample.error == "TransportError: loopback does not declare the stage greet"


STAGES = {**COMMON, "json_pack": "pack"}
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


class ElsewhereClient:
    """Answers as a server whose clock is ``ahead_ns`` of this host's; an answer takes 4 ms or more."""

    def __init__(self) -> None:
        self.ahead_ns = 10**12
        self.prompts: list[str] = []
        self.facts: dict[str, float] = {}

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        self.prompts.append(request.prompt)
        trace.mark("json_pack")
        sent_ns = trace.marks[-1][1]
        came_ns, left_ns = sent_ns + 3_000_000, sent_ns + 3_500_000
        SystemClock().sleep_until_ns(sent_ns + 4_000_000)
        trace.mark("return")
        yield Token(0, "x")
        if not request.prompt.startswith(CLOCK_PROMPT):
            self.true = came_ns - sent_ns, trace.marks[-1][1] - left_ns
        marks = [("network", came_ns + self.ahead_ns), ("inference", left_ns + self.ahead_ns)]
        trace.receive(Remote(ELSEWHERE, marks, [left_ns + self.ahead_ns], facts=self.facts))


@pytest.fixture
def elsewhere() -> tuple[ElsewhereClient, Session]:
    client = ElsewhereClient()
    return client, session_of(client, offsets={})


def test_one_way_times_to_another_host_are_intervals_that_hold_the_truth(
    elsewhere: tuple[ElsewhereClient, Session],
) -> None:
    client, session = elsewhere
    for block in range(3):
        measured = session.measure(Place(block, 0, warmup=False))
        sample, (token,) = measured.sample, measured.tokens
        assert not sample.error
        values = dict(zip(samples_table(STAGES).columns, samples_table(STAGES).values(sample), strict=True))
        for name, truth in zip(("network", "return"), client.true, strict=True):
            assert values[f"{name}_ns"] is None
            assert values[f"{name}_lo_ns"] <= truth <= values[f"{name}_hi_ns"]  # type: ignore[operator]
        assert values["round_trip_ns"] == sum(client.true)
        assert values["inference_ns"] == 500_000
        assert token.engine_ns is None
        assert token.engine_lo_ns <= token.client_ns - client.true[1] <= token.engine_hi_ns  # type: ignore[operator]
        assert sample.frame_age_ns is None
        assert 0 <= sample.frame_age_lo_ns <= sample.frame_age_hi_ns  # type: ignore[operator]
    asked = [prompt.startswith(CLOCK_PROMPT) for prompt in client.prompts]
    assert asked[:21] == [False, *[True] * 20]


def test_without_exchanges_the_requests_alone_bound_the_offset(elsewhere: tuple[ElsewhereClient, Session]) -> None:
    client, shared = elsewhere
    session, least_ns = Session(shared.cell, client, shared.feed, shared.request), 10**9
    for block in range(3):
        sample = session.measure(Place(block, 0, warmup=False)).sample
        assert not sample.error
        least_ns = min(least_ns, sum(client.true))  # a request before it may have been faster
        assert sample.clock_error_ns >= (least_ns - 1) // 2  # type: ignore[operator]
    assert len(client.prompts) == 3


def test_a_clock_that_is_set_ends_the_run_with_one_line(elsewhere: tuple[ElsewhereClient, Session]) -> None:
    client, session = elsewhere
    session.measure(Place(0, 0, warmup=True))
    client.ahead_ns += 60 * 10**9
    measured = session.measure(Place(1, 0, warmup=False))
    assert isinstance(measured.fatal, ClockMoved)
    assert measured.sample.error.startswith("ClockMoved: the clocks of the two hosts moved against each other by about")
    assert "chronyc waitsync" in measured.sample.error


def test_a_server_elsewhere_without_marks_cannot_be_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trace, "receive", lambda trace, remote: setattr(trace, "remote", replace(remote, marks=[])))
    measured = session_of(ElsewhereClient(), offsets={}).measure(Place(0, 0, warmup=False))
    assert "the server reported no marks" in measured.sample.error


def with_wall_clocks(
    client: ElsewhereClient, monkeypatch: pytest.MonkeyPatch, *, off_ms: float = 0, tells: bool = True
) -> Measured:
    """Measure where both wall clocks are known to 20 us, the server's after all off by ``off_ms``."""
    ours = WallClock(17 * 10**17, 20_000, 0)
    monkeypatch.setattr("s2a_bench.harness.clocks.wall_clock", lambda _: ours)
    theirs_ms = (ours.offset_ns - client.ahead_ns) / 1e6 + off_ms
    client.facts = {REALTIME_MS: theirs_ms, REALTIME_ERROR_MS: ours.error_ns / 1e6} if tells else {}
    request = replace(resolve(RequestsConfig()).request, clock="chrony")
    return session_of(client, request=request, offsets={}).measure(Place(0, 0, warmup=False))


def test_bounds_of_the_wall_clocks_narrow_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    client = ElsewhereClient()
    measured = with_wall_clocks(client, monkeypatch)
    assert not measured.sample.error
    assert client.prompts[-1] == f"{CLOCK_PROMPT}tokens chrony"
    offset = Offset()
    offset.add(Exchange(0, 5_000_000, 5_000_000, 2_000_000))
    exchanged = offset.over(2_000_000)
    offset.add(Bounded(1_000_000, 2_000_000, middle_ns=4_000_000, error_ns=50_000))
    both = offset.over(2_000_000)
    assert (both.lo_ns, both.hi_ns) == (pytest.approx(3_950_000, abs=2), pytest.approx(4_050_000, abs=2))
    assert both.hi_ns - both.lo_ns < exchanged.hi_ns - exchanged.lo_ns


def test_wall_clocks_that_contradict_the_exchanges_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = with_wall_clocks(ElsewhereClient(), monkeypatch, off_ms=60_000)
    assert isinstance(measured.fatal, ClockMoved)


def test_a_server_that_does_not_tell_its_wall_clock_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = with_wall_clocks(ElsewhereClient(), monkeypatch, tells=False)
    assert "the server does not tell its wall clock" in measured.sample.error
