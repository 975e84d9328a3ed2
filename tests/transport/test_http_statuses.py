"""What HTTP's clients hear of impossible numbers and texts, of the queue, and of a stuck engine."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from threading import Event, Thread
from typing import Any

import httpx
import pytest

from s2a_bench.errors import BadRequest, RequestFailed
from s2a_bench.testing.transport import RecordingHandler, ask, wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PARAMETERS_HEADER, PATHS
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.serving import Queued, Turns
from s2a_bench.types import Request, Token
from tests.transport.test_http import serving
from tests.waiting import until

CHAT, BEST_EFFORT = PATHS["as-deployed"], PATHS["best-effort"]
SERVERS = {CHAT: "http", BEST_EFFORT: "http/best-effort"}
paths = pytest.mark.parametrize("path", [CHAT, BEST_EFFORT])


def body(*, stream: bool = True) -> dict[str, Any]:
    return {"messages": [{"role": "user", "content": "go on"}], "stream": stream}


VARIANTS = {"as-deployed": "http", "best-effort": "http/best-effort", "binary": "http/binary"}
ODD_NUMBERS = [
    *(("max_tokens", value) for value in ("-1", "0", "1.5", "1e99", '"many"', str(LIMITS.answer_tokens + 1))),
    *(("seed", value) for value in ("-1", "[]", "true", str(2**32))),
]


def post(url: str, variant: str, fields: str, prompt: str = '"go on"') -> httpx.Response:
    """Send a request of a variant, whose prompt and ``fields`` are JSON text."""
    if variant == "binary":
        return httpx.post(url + PATHS[variant], headers={PARAMETERS_HEADER: f'{{"prompt": {prompt}, {fields}}}'})
    text = f'{{"messages": [{{"role": "user", "content": {prompt}}}], {fields}}}'
    return httpx.post(url + PATHS[variant], content=text.encode(), headers={"content-type": "application/json"})


@pytest.mark.parametrize("variant", VARIANTS)
def test_numbers_and_texts_that_are_none_are_refused_by_name_and_hold_no_engine(variant: str) -> None:
    with serving(RecordingHandler(["a"]), VARIANTS[variant]) as url:
        for name, value in ODD_NUMBERS:
            answer = post(url, variant, f'"{name}": {value}')
            assert (answer.status_code, value) == (400, value)
            assert name in answer.json()["error"]["message"]
        for stream in ("true", "false"):
            assert post(url, variant, f'"request_id": "\\ud800", "stream": {stream}').status_code == 400
            assert post(url, variant, f'"stream": {stream}', prompt='"\\ud800"').status_code == 400
        whole = post(url, variant, f'"max_tokens": 1, "seed": {2**32 - 1}')
        assert whole.json()["usage"]["completion_tokens"] == 1


def test_a_raw_picture_of_negative_sides_is_refused() -> None:
    headers = {PARAMETERS_HEADER: "{}", "content-type": "application/x-raw;width=-1;height=-3;encoding=bgr8"}
    with serving(RecordingHandler(["a"]), "http/binary") as url:
        assert httpx.post(url + PATHS["binary"], content=b"abc" * 3, headers=headers).status_code == 400


def test_leaving_twice_lets_one_run_not_two() -> None:
    turns = Turns()
    first, second, third = (turns.join() for _ in range(3))
    first.leave()
    first.leave()
    assert second.has_started
    assert not third.has_started


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
    go = Event()

    def stuck(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        yield Token(0, "a")
        go.wait(30)

    with serving(stuck, SERVERS[path]) as url:
        assert httpx.get(url + "/health").status_code == 200
        asking = Thread(target=httpx.post, args=(url + path,), kwargs={"json": body(), "timeout": 60})
        asking.start()
        until(lambda: httpx.get(url + "/health").status_code == 503)
        assert "no sign of life" in httpx.get(url + "/health").json()["reason"]
        go.set()
        asking.join()
        assert httpx.get(url + "/health").status_code == 200


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
