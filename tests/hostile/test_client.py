"""The HTTP client against every server of `tests.servers.hostile`: one line, little time, little memory."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from threading import Event

import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.testing.transport import connector, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http import detect
from s2a_bench.types import Request, Token
from tests.servers.hostile import CASES, DIALECT, MAX_TOKENS, Case, delta
from tests.servers.sockets import head, serving


def memory_mib(name: str) -> float:
    """A line of /proc/self/status: VmRSS is now, VmHWM the most since it was reset."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024


@pytest.fixture(autouse=True)
def little_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask a server what it is for a tenth of the time; the run in a process of its own asks for all of it."""
    monkeypatch.setattr(detect, "PATIENCE_S", detect.PATIENCE_S / 10)


@pytest.fixture(params=CASES.values(), ids=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    found: Case = request.param
    return found


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
def test_it_ends_in_one_line_and_costs_little(case: Case, variant: str) -> None:
    with serving(lambda _: case.pieces()) as url:
        client = open_client(wiring_of(f"http/{variant}", url=url, dialect=DIALECT, deadline_s=case.deadline_s))
        Path("/proc/self/clear_refs").write_text("5")
        before_mib, started = memory_mib("VmRSS"), time.monotonic()
        with pytest.raises(RequestFailed, match=case.says) as caught:
            list(client.request(Request("a", "plan", max_tokens=MAX_TOKENS), Trace()))
        seconds, mib = time.monotonic() - started, memory_mib("VmHWM") - before_mib
        client.close()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert seconds < case.seconds
    assert mib < case.mib


def test_who_asks_what_a_server_is_does_not_wait_for_ever() -> None:
    with serving(lambda _: CASES["another media type"].pieces()) as url:
        started = time.monotonic()
        client = open_client(wiring_of("http/as-deployed", url=url))
        assert client.describe()["dialect"] == "openai"
        assert time.monotonic() - started < detect.PATIENCE_S + 10
        client.close()


@pytest.mark.parametrize("name", ["ros/topic", "ros/action"])
def test_ros_clients_have_the_same_deadline(name: str) -> None:
    left = Event()

    def talks(request: Request, trace: Trace) -> Generator[Token, None, None]:
        del request, trace
        for index in count():
            yield Token(index, "go ")
            if left.wait(0.2):
                return

    wiring = wiring_of(name, deadline_s=1)
    with contextmanager(connector)(wiring) as connect:
        client = connect(talks)
        try:
            with pytest.raises(RequestFailed, match="within 1 s; see `deadline`"):
                list(client.request(Request("a", "plan", max_tokens=1), Trace()))
        finally:
            left.set()


def test_a_server_that_counts_otherwise_is_not_cut() -> None:
    """A gateway may send letters, and what a model thinks beside."""
    pieces = [head(), *[delta(reasoning_content="h")] * 999, *[delta(content="x")] * 40, b"data: [DONE]\n\n"]
    with serving(lambda _: pieces) as url:
        client = open_client(wiring_of("http/as-deployed", url=url, dialect=DIALECT))
        assert len(list(client.request(Request("a", "plan", max_tokens=MAX_TOKENS), Trace()))) == 40
        client.close()
