"""The HTTP server and client beyond the contract."""

from __future__ import annotations

import base64
import json
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from itertools import count
from threading import Event, Thread, get_ident

import cv2
import httpx
import numpy as np
import pytest

from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import Remote, Trace, budget
from s2a_bench.transport import Handler, open_client, open_server
from s2a_bench.transport.http import native
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.types import Request, Token


@pytest.fixture
def handler() -> RecordingHandler:
    return RecordingHandler(["go", "_to"])


@contextmanager
def serving(handler: Handler, name: str = "http", limits: Limits = LIMITS) -> Iterator[str]:
    """Serve for as long as the context lasts."""
    with served(replace(wiring_of(name), limits=limits), handler) as (server, _):
        yield server.address


@pytest.fixture
def url(handler: RecordingHandler) -> Iterator[str]:
    with serving(handler) as address:
        yield address


@pytest.fixture
def urls(url: str, handler: RecordingHandler) -> Iterator[dict[str, str]]:
    """Our servers, by the variants that they answer."""
    with serving(handler, "http/best-effort") as fast:
        yield {"as-deployed": url, "best-effort": fast, "binary": fast}


COMMON = {"convert", "json_pack", "network", "json_parse", "inference", "return"}


@pytest.mark.parametrize(
    ("variant", "payload", "expected"),
    [
        ("as-deployed", "jpeg", {"image_encode", "base64_encode", "base64_decode", "image_decode"}),
        ("as-deployed", "raw", {"base64_encode", "base64_decode", "channel_swap"}),
        ("best-effort", "png", {"image_encode", "base64_encode", "base64_decode", "image_decode"}),
        ("binary", "jpeg", {"image_encode", "image_decode"}),
        ("binary", "raw", {"channel_swap"}),
    ],
)
def test_each_variant_has_its_stages_and_no_other(
    urls: dict[str, str], variant: str, payload: str, expected: set[str]
) -> None:
    with closing(open_client(wiring_of(f"http/{variant}", urls[variant], payload=payload))) as client:
        _, trace = ask(client, Request("a", "plan", (yuyv_frame(),)))
    assert set(budget(trace.chain()).stages_ns) == COMMON | expected


def test_a_new_client_per_request_shows_as_connect(url: str) -> None:
    client = open_client(wiring_of("http/as-deployed", url, connection="client-per-request"))
    _, trace = ask(client, Request("a", "plan"))
    assert "connect" in budget(trace.chain()).stages_ns


def test_our_own_server_is_known_by_its_url_and_keeps_its_marks(url: str) -> None:
    client = open_client(wiring_of("http/as-deployed", url=url))
    _, trace = ask(client, Request("a", "plan"))
    client.close()
    assert client.describe() == {"url": url + "/v1/chat/completions", "dialect": "s2a", "model": "s2a"}
    assert set(budget(trace.chain()).stages_ns) == {"json_pack", "network", "json_parse", "inference", "return"}


def test_marks_of_another_hosts_clock_are_not_mixed_with_ours(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.trace.clock_id", lambda: "another boot")
    monkeypatch.setattr(Remote, "to_json", lambda remote: {**asdict(remote), "clock": "this boot"})
    client = open_client(wiring_of("http/as-deployed", url))
    _, trace = ask(client, Request("a", "plan"))
    client.close()
    assert set(budget(trace.chain()).stages_ns) == {"json_pack", "server"}


@pytest.mark.parametrize(("connection", "connections"), [("keep-alive", 1), ("per-request", 3)])
def test_connections_are_kept_or_not(
    handler: RecordingHandler, connection: str, connections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    opened = []
    connect = socket.create_connection
    monkeypatch.setattr(socket, "create_connection", lambda *a, **k: opened.append(1) or connect(*a, **k))
    with (
        serving(handler) as url,
        closing(open_client(wiring_of("http/as-deployed", url, connection=connection))) as client,
    ):
        for _ in range(3):
            ask(client, Request("a", "plan"))
    assert len(opened) == connections


def test_the_whole_answer_comes_without_stream(url: str) -> None:
    body = {"messages": [{"role": "user", "content": "plan"}], "max_tokens": 2}
    answer = httpx.post(url + "/v1/chat/completions", json=body).json()
    assert answer["choices"][0] == {
        "index": 0,
        "message": {"role": "assistant", "content": "go_to"},
        "finish_reason": "length",
    }
    assert answer["usage"]["completion_tokens"] == 2


def test_the_stream_is_what_openai_clients_expect(url: str) -> None:
    body = {"messages": [{"role": "user", "content": [{"type": "text", "text": "plan"}]}], "stream": True}
    lines = httpx.post(url + "/v1/chat/completions", json=body).text.split("\n\n")
    assert lines[-2:] == ["data: [DONE]", ""]
    events = [json.loads(line.removeprefix("data: ")) for line in lines[:-2]]
    assert [event["choices"][0]["delta"] for event in events[:-1]] == [{"content": "go"}, {"content": "_to"}, {}]
    assert events[-2]["choices"][0]["finish_reason"] == "stop"
    assert events[-1]["choices"] == []
    assert [stage for stage, _ in events[-1]["s2a"]["marks"]] == [
        "network",
        "json_parse",
        "json_parse",
        "",
        "inference",
    ]


def test_a_picture_from_a_plain_openai_client_is_decoded(url: str, handler: RecordingHandler) -> None:
    picture = np.full((8, 8, 3), (255, 0, 0), np.uint8)  # blue in OpenCV's order
    uri = "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", picture)[1]).decode()
    part = {"type": "image_url", "image_url": {"url": uri}}
    httpx.post(url + "/v1/chat/completions", json={"messages": [{"role": "user", "content": [part]}]})
    assert handler.requests[0].images[0].data[0, 0].tolist() == [0, 0, 255]


@pytest.mark.parametrize(
    ("variant", "body", "message"),
    [
        ("as-deployed", b"{}", "body.messages"),
        ("as-deployed", b"{", "JSON"),
        ("best-effort", b"{", "no JSON"),
        ("best-effort", b"{}", "messages"),
        ("as-deployed", b'{"messages": []}', "messages"),
        ("best-effort", b'{"messages": []}', "messages"),
        ("best-effort", b'{"messages": [{"content": "go"}], "max_tokens": "many"}', "max_tokens"),
        ("best-effort", b'{"messages": [{"content": [{"type": "text", "text": 3}]}]}', "messages"),
        ("best-effort", b"[" * 20_001, "no JSON"),
        ("binary", b"", "s2a-request"),
    ],
)
def test_a_bad_body_is_refused_with_the_reason(urls: dict[str, str], variant: str, body: bytes, message: str) -> None:
    headers = {"content-type": "application/json"}
    answer = httpx.post(urls[variant] + native.PATHS[variant], content=body, headers=headers)
    assert answer.status_code == 400
    assert message in answer.json()["error"]["message"]


@pytest.mark.parametrize("header", ["[1]", '{"prompt": 3}', '{"seed": [1]}'])
def test_a_bad_header_of_a_binary_request_is_refused(urls: dict[str, str], header: str) -> None:
    headers = {native.PARAMETERS_HEADER: header}
    assert httpx.post(urls["binary"] + native.PATHS["binary"], headers=headers).status_code == 400


def test_an_answer_that_nobody_reads_any_more_ends_on_its_own_thread() -> None:
    threads: list[int] = []
    gone, ended = Event(), Event()

    def endless(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        try:
            for index in count():
                threads.append(get_ident())
                yield Token(index, "go")
                if index:
                    gone.wait(30)
        finally:
            threads.append(get_ident())
            ended.set()

    body = {"messages": [{"role": "user", "content": "plan"}], "stream": True}
    with serving(endless) as url:
        with httpx.stream("POST", url + "/v1/chat/completions", json=body) as answer:
            next(answer.iter_bytes())
        gone.set()
        assert ended.wait(30)
    assert threads[-1] == threads[-2]  # not the loop's: the end may wait for the engine


def test_stopping_in_the_middle_of_an_answer_leaves_no_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    over = Event()

    def slow(_request: Request, _trace: Trace) -> Generator[Token, None, None]:
        yield Token(0, "go")
        over.wait(30)
        yield Token(1, "on")

    server = open_server(wiring_of("http"), slow)
    thread = Thread(target=server.serve)
    thread.start()
    body = {"messages": [{"role": "user", "content": "plan"}], "stream": True}
    with httpx.stream("POST", server.address + "/v1/chat/completions", json=body) as answer:
        pieces = answer.iter_bytes()
        next(pieces)
        server.stop()
        with pytest.raises(httpx.RemoteProtocolError):
            list(pieces)
    over.set()
    thread.join()
    stderr = capsys.readouterr().err
    assert "graceful shutdown exceeded" in stderr
    assert "Traceback" not in stderr


@pytest.mark.parametrize("uri", ["http://example.org/x.jpg", "data:image/jpeg;base64,AAAA", "data:image/png;base64,%"])
def test_a_bad_picture_is_refused_with_the_reason(url: str, uri: str) -> None:
    part = {"type": "image_url", "image_url": {"url": uri}}
    body = {"messages": [{"role": "user", "content": [part]}]}
    assert httpx.post(url + "/v1/chat/completions", json=body).status_code == 400


def test_health_and_models_answer(urls: dict[str, str]) -> None:
    for url in urls.values():
        assert httpx.get(url + "/health").json() == {"status": "ok"}
        assert httpx.get(url + "/v1/models").json()["data"][0]["id"] == "s2a"


@pytest.mark.parametrize(("options", "status"), [({}, 404), ({"api_docs": True}, 200)])
def test_the_pages_of_fastapi_are_served_on_request_only(
    handler: RecordingHandler, options: dict[str, bool], status: int
) -> None:
    with served(wiring_of("http", **options), handler) as (server, _):
        for page in ("/openapi.json", "/docs", "/redoc"):
            assert httpx.get(server.address + page).status_code == status


def test_best_effort_and_binary_share_a_server_and_as_deployed_has_its_own() -> None:
    deployed, best_effort, binary = (one_pipeline(f"http/{name}").server for name in native.PATHS)
    assert deployed != best_effort == binary
