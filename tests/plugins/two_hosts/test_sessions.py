"""Sessions whose server is on another host: one-way times, and what cannot be told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from s2a_bench.clock import SystemClock, VirtualClock
from s2a_bench.errors import ClockMoved
from s2a_bench.frames import open_source
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.session import Measured, Place, Session
from s2a_bench.machine.clocks import REALTIME_ERROR_MS, REALTIME_MS, WallClock
from s2a_bench.plugins.two_hosts.surroundings import TwoHosts
from s2a_bench.store.requests import samples_table
from s2a_bench.trace import STAGES as COMMON
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.serving import CLOCK_PROMPT
from s2a_bench.types import Request, Token

STAGES = {**COMMON, "json_pack": "pack"}
ELSEWHERE = "another machine"


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


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exchange one after another instead of over a second."""
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.SystemClock", VirtualClock)


def session_of(client: ElsewhereClient, *surroundings: TwoHosts) -> Session:
    feed = RequestFeed(open_source("synthetic", 64, 48, fps=30.0, seed=0), preencoded=False)
    plan = resolve(RequestsConfig(), print).request
    plan = replace(plan, surroundings=surroundings or plan.surroundings)
    return Session(one_pipeline("http/as-deployed"), client, feed, plan, clocks={})


@pytest.fixture
def elsewhere() -> tuple[ElsewhereClient, Session]:
    client = ElsewhereClient()
    return client, session_of(client)


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


def with_wall_clocks(client: ElsewhereClient, monkeypatch: pytest.MonkeyPatch, *, off_ms: float = 0) -> Measured:
    """Measure where both wall clocks are known to 20 us, the server's after all off by ``off_ms``."""
    ours = WallClock(17 * 10**17, 20_000, 0)
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.WALL_CLOCKS", {"chrony": lambda: ours})
    theirs_ms = (ours.offset_ns - client.ahead_ns) / 1e6 + off_ms
    client.facts = {REALTIME_MS: theirs_ms, REALTIME_ERROR_MS: ours.error_ns / 1e6}
    return session_of(client, TwoHosts(system="chrony")).measure(Place(0, 0, warmup=False))


def test_a_server_is_asked_for_its_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    client = ElsewhereClient()
    measured = with_wall_clocks(client, monkeypatch)
    assert not measured.sample.error
    assert client.prompts[-1] == f"{CLOCK_PROMPT}tokens chrony"


def test_wall_clocks_that_contradict_the_exchanges_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = with_wall_clocks(ElsewhereClient(), monkeypatch, off_ms=60_000)
    assert isinstance(measured.fatal, ClockMoved)


def test_without_what_knows_the_other_clock_all_up_to_the_answer_is_the_server(
    elsewhere: tuple[ElsewhereClient, Session],
) -> None:
    client, shared = elsewhere
    session = Session(shared.cell, client, shared.feed, replace(shared.request, surroundings=()), clocks={})
    sample = session.measure(Place(0, 0, warmup=False)).sample
    assert (sample.error, sample.clock_error_ns, sample.frame_age_ns) == ("", None, None)
    assert sample.marks[-1][0] == "server"
    assert len(client.prompts) == 1
