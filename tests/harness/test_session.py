"""A session: a server that asks to be left alone is left alone for a bounded time, and what its marks mean."""

from __future__ import annotations

import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.frames import open_source
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import back_off
from s2a_bench.harness.session import Place, Session, inference_start_ns
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.pipeline import one_pipeline
from tests.servers.sockets import head, serving
from tests.servers.speakers import Cloud


@pytest.mark.parametrize(("retry_after_s", "waited_s"), [(0.0, 0), (1.5, 1.5), (60.0, 60), (3600.0, 60)])
def test_the_wait_is_what_was_asked_up_to_a_minute(retry_after_s: float, waited_s: float) -> None:
    clock, lines = VirtualClock(5), []
    back_off("http/as-deployed", retry_after_s, clock, lines.append)
    assert clock.now_ns() - 5 == waited_s * 1e9
    assert lines == ([f"waiting {waited_s:g} s, as the server of http/as-deployed asks"] if retry_after_s else [])


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
        source = open_source("synthetic", 64, 48, fps=30.0, seed=0)
        session = Session(cell, client, RequestFeed(source, preencoded=False), resolve(RequestsConfig()).request)
        measured = session.measure(Place(0, 0, warmup=False))
        client.close()
        source.close()
    assert measured.retry_after_s == retry_after_s
    assert "answered 429: slow down" in measured.sample.error
    assert (measured.fatal, measured.tokens, len(requests)) == (None, [], 1)


@pytest.mark.parametrize("inside", [["inference"], ["preprocess", "inference"]])
def test_inference_starts_where_the_engine_gets_the_request(inside: list[str]) -> None:
    trace = Trace()
    trace.marks = [(stage, 10 * place) for place, stage in enumerate(["", "capture", "queue", *inside, "return"])]
    assert inference_start_ns(trace) == 20
