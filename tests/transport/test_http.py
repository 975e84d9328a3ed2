"""The HTTP server and client beyond the contract."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import httpx
import pytest

from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import budget
from s2a_bench.transport import Handler, open_client
from s2a_bench.transport.http import native
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.types import Request
from tests.transport.test_every_server import Gate


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


def test_our_own_server_is_known_by_its_url_and_keeps_its_marks(url: str) -> None:
    client = open_client(wiring_of("http/as-deployed", url=url))
    _, trace = ask(client, Request("a", "plan"))
    client.close()
    assert client.describe() == {"url": url + "/v1/chat/completions", "dialect": "s2a", "model": "s2a"}
    assert set(budget(trace.chain()).stages_ns) == {"json_pack", "network", "json_parse", "inference", "return"}


@pytest.mark.parametrize(
    ("connection", "connections"), [("keep-alive", 1), ("per-request", 3), ("client-per-request", 3)]
)
def test_connections_are_kept_or_not(
    url: str, connection: str, connections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    connect = socket.create_connection
    monkeypatch.setattr(socket, "create_connection", lambda *a, **k: opened.append(1) or connect(*a, **k))
    with closing(open_client(wiring_of("http/as-deployed", url, connection=connection))) as client:
        traces = [ask(client, Request("a", "plan"))[1] for _ in range(3)]
    assert len(opened) == connections
    shows = connection == "client-per-request"
    assert [("connect" in budget(trace.chain()).stages_ns) for trace in traces] == [shows] * 3


def test_the_whole_answer_comes_without_stream(url: str) -> None:
    body = {"messages": [{"role": "user", "content": "plan"}], "max_tokens": 2}
    answer = httpx.post(url + "/v1/chat/completions", json=body).json()
    message = {"role": "assistant", "content": "go_to"}
    assert answer["choices"] == [{"index": 0, "message": message, "finish_reason": "length"}]
    assert answer["usage"]["completion_tokens"] == 2


def test_the_stream_is_what_openai_clients_expect(url: str) -> None:
    body = {"messages": [{"role": "user", "content": [{"type": "text", "text": "plan"}]}], "stream": True}
    lines = httpx.post(url + "/v1/chat/completions", json=body).text.split("\n\n")
    assert lines[-2:] == ["data: [DONE]", ""]
    events = [json.loads(line.removeprefix("data: ")) for line in lines[:-2]]
    assert [event["choices"][0]["delta"] for event in events[:-1]] == [{"content": "go"}, {"content": "_to"}, {}]
    assert events[-2]["choices"][0]["finish_reason"] == "stop"
    assert events[-1]["choices"] == []
    stages = [stage for stage, _ in events[-1]["s2a"]["marks"]]
    assert stages == ["network", "json_parse", "json_parse", "", "inference"]


@pytest.mark.parametrize(
    ("variant", "sent", "message"),
    [
        ("as-deployed", "{}", "body.messages"),
        ("as-deployed", "{", "JSON"),
        ("as-deployed", '{"messages": []}', "messages"),
        ("best-effort", "{", "not JSON"),
        ("best-effort", "{}", "messages"),
        ("best-effort", '{"messages": []}', "messages"),
        ("best-effort", '{"messages": [{"content": [{"type": "text", "text": 3}]}]}', "messages"),
        ("binary", "", "s2a-request"),
        ("binary", "[1]", "an object"),
        ("binary", '{"prompt": 3}', "prompt"),
        ("binary", '{"seed": [1]}', "seed"),
    ],
)
def test_a_bad_body_or_header_is_refused_with_the_reason(
    urls: dict[str, str], variant: str, sent: str, message: str
) -> None:
    headers, body = {"content-type": "application/json"}, sent
    if variant == "binary" and sent:
        headers, body = {native.PARAMETERS_HEADER: sent}, ""
    answer = httpx.post(urls[variant] + native.PATHS[variant], content=body, headers=headers)
    assert answer.status_code == 400
    assert message in answer.json()["error"]["message"]


def test_stopping_in_the_middle_of_an_answer_waits_for_no_engine(capsys: pytest.CaptureFixture[str]) -> None:
    gate = Gate("http/as-deployed")
    body = {"messages": [{"role": "user", "content": "plan"}], "stream": True}
    with (
        served(wiring_of("http"), gate) as (server, _),
        httpx.stream("POST", server.address + "/v1/chat/completions", json=body) as answer,
    ):
        pieces = answer.iter_bytes()
        next(pieces)
        server.stop()
        with pytest.raises(httpx.RemoteProtocolError):
            list(pieces)
        gate.go.set()
    stderr = capsys.readouterr().err
    assert "graceful shutdown exceeded" in stderr
    assert "Traceback" not in stderr


@pytest.mark.parametrize("uri", ["http://example.org/x.jpg", "data:image/jpeg;base64,AAAA", "data:image/png;base64,%"])
def test_a_bad_picture_is_refused_with_the_reason(url: str, uri: str) -> None:
    part = {"type": "image_url", "image_url": {"url": uri}}
    body = {"messages": [{"role": "user", "content": [part]}]}
    assert httpx.post(url + "/v1/chat/completions", json=body).status_code == 400


@pytest.mark.parametrize(("options", "status"), [({}, 404), ({"api_docs": True}, 200)])
def test_health_and_models_answer_and_on_request_the_pages_of_fastapi(
    urls: dict[str, str], handler: RecordingHandler, options: dict[str, bool], status: int
) -> None:
    for url in urls.values():
        assert httpx.get(url + "/health").json() == {"status": "ok"}
        assert httpx.get(url + "/v1/models").json()["data"][0]["id"] == "s2a"
    with served(wiring_of("http", **options), handler) as (server, _):
        for page in ("/openapi.json", "/docs", "/redoc"):
            assert httpx.get(server.address + page).status_code == status
