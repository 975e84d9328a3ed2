"""A server's memory is bounded: by the size of a body, by its connections, its queue, and the time of an answer."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path

import httpx
import pytest

from s2a_bench.testing.transport import served, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.transport.limits import Limits
from s2a_bench.types import Request, Token
from tests.hostile.peers import PATIENCE_S, PEAK_MIB, Case, Target, crowd, normal_answer, own_server, sends, usage
from tests.hostile.test_any_bytes import cases
from tests.hostile.wires import http, iceoryx2, ros, websocket, zmq
from tests.waiting import until

LARGE: dict[str, Sequence[Case]] = {
    "http": http.LARGE,
    "http/best-effort": http.FAST_LARGE,
    "websocket/openpi": websocket.LARGE,
    "zmq/gr00t": zmq.LARGE,
    "iceoryx2": iceoryx2.LARGE,
    "ros/topic": ros.LARGE,
}


NAMES = {PATHS["as-deployed"]: "http", PATHS["best-effort"]: "http/best-effort"}


@pytest.mark.slow
@cases(LARGE)
def test_what_is_large_or_many_costs_little_memory_and_the_next_client_is_served(
    targets: Callable[[str], Target], name: str, case: Case
) -> None:
    targets(name).meets(case)


@pytest.mark.slow
def test_the_memory_of_large_bodies_is_given_back(targets: Callable[[str], Target]) -> None:
    """FastAPI's errors hold the body, in cycles that Python looks for when it likes; grown blocks stay in the heap."""
    (spaces,) = (case for case in http.LARGE if case.name == "60 MiB of spaces")
    target = targets("http")
    before = usage(target.server.pid).rss_mib
    for _ in range(5):
        target.meets(spaces)
    until(lambda: usage(target.server.pid).rss_mib < before + 100)


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "stream"), [("as-deployed", "true"), ("best-effort", "false")])
def test_of_1000_clients_at_once_each_is_answered_or_refused(tmp_path: Path, variant: str, stream: str) -> None:
    wiring = wiring_of(f"http/{variant}")
    chat = http.chat(PATHS[variant], fields=f'"stream": {stream}, "max_tokens": 3')
    whole = {"true": r"data: \[DONE\]", "false": '"completion_tokens":3'}[stream]
    with own_server(wiring, tmp_path / "log") as server:
        bound = replace(wiring, address=server.address)
        says = f"{whole}|^HTTP/1.1 503 .*retry-after: |<closed>"
        reply = crowd(1000, sends(chat))(bound, says)
        assert reply.startswith("HTTP/1.1 ")
        assert usage(server.pid).peak_mib < PEAK_MIB
        with closing(open_client(bound)) as client:
            assert len(normal_answer(client)) == 3


@pytest.mark.parametrize("path", [PATHS["as-deployed"], PATHS["best-effort"]])
def test_an_answer_without_end_is_504_at_its_deadline(path: str) -> None:
    def endless(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        for index in count():
            yield Token(index, "go ")

    wiring = replace(wiring_of(NAMES[path]), limits=Limits(answer_s=0.3))
    body = {"messages": [{"role": "user", "content": "for ever"}], "max_tokens": 60_000}
    with served(wiring, endless) as (server, _):
        answer = httpx.post(server.address + path, json=body, timeout=PATIENCE_S)
    assert answer.status_code == 504
    assert "0.3 s after its arrival the request is still being answered" in answer.json()["error"]["message"]
