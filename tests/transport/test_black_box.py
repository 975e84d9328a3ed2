"""The HTTP client against a llama-server, well-behaved and not, byte by byte; see test_dialects for the others."""

from __future__ import annotations

import json
import socketserver
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.testing.transport import wiring, yuyv_frame
from s2a_bench.trace import RESIDUAL, Trace, budget
from s2a_bench.transport import open_client
from s2a_bench.types import Request

Script = list[bytes]
Serve = Callable[..., str]


def http_head(status: str = "200 OK", kind: str = "text/event-stream") -> bytes:
    """The head of a response that ends with its connection."""
    return f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nConnection: close\r\n\r\n".encode()


def event(**fields: Any) -> bytes:
    """One server-sent event."""
    return b"data: " + json.dumps(fields, ensure_ascii=False).encode() + b"\n\n"


def delta(**fields: Any) -> bytes:
    """One chunk of a chat completion."""
    return event(choices=[{"index": 0, "delta": fields, "finish_reason": None}])


TIMINGS = {"cache_n": 3, "prompt_n": 218, "prompt_ms": 97.5, "predicted_n": 2, "predicted_ms": 12.0}
FINISH = event(choices=[{"index": 0, "delta": {}, "finish_reason": "stop"}])
USAGE = event(choices=[], usage={"prompt_tokens": 221}, timings=TIMINGS)
DONE = b"data: [DONE]\n\n"
LLAMA_SERVER: Script = [
    http_head(),
    delta(role="assistant", content=None),
    event(choices=[{"index": 0, "delta": {"role": "assistant"}}], prompt_progress={"total": 218, "processed": 64}),
    delta(content="go"),
    delta(content="_to"),
    FINISH,
    USAGE,
    DONE,
]
"""What llama-server sends."""


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Start servers that answer every request with a script, and keep what they were sent."""
    servers = []

    def start(script: Script, bodies: list[dict[str, Any]] | None = None) -> str:
        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                length = 0
                while line := self.rfile.readline().strip():
                    if line.lower().startswith(b"content-length:"):
                        length = int(line.split(b":")[1])
                body = self.rfile.read(length)
                if bodies is not None:
                    bodies.append(json.loads(body))
                for part in script:
                    self.wfile.write(part)
                    self.wfile.flush()

        server = socketserver.TCPServer(("127.0.0.1", 0), Handler)
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_address[1]}"

    yield start
    for server, thread in servers:
        server.shutdown()
        thread.join()
        server.server_close()


def ask(url: str, request: Request | None = None) -> tuple[list[str], Trace]:
    """Ask a black box; return the texts and the trace."""
    client = open_client(wiring("http/as-deployed", url=url, payload="jpeg", dialect="llama-server"))
    trace = Trace()
    trace.mark(RESIDUAL)
    try:
        tokens = list(client.request(request or Request("a", "plan", (yuyv_frame(),)), trace))
    finally:
        client.close()
    return [token.text for token in tokens], trace


def test_llama_server_gives_ingest_inference_and_timings(serve: Serve) -> None:
    begin = now_ns()
    texts, trace = ask(serve(LLAMA_SERVER))
    assert texts == ["go", "_to"]
    spent = budget(trace.chain())
    assert {"convert", "image_encode", "base64_encode", "json_pack", "ingest", "inference"} == set(spent.stages_ns)
    assert sum(spent.stages_ns.values()) + spent.residual_ns == spent.e2e_ns <= now_ns() - begin
    assert trace.facts["prompt_ms"] == 97.5
    assert trace.facts["cache_n"] == 3
    assert trace.remote is None


def test_a_server_that_tells_nothing_has_one_stage_server(serve: Serve) -> None:
    texts, trace = ask(serve([http_head(), delta(role="assistant", content=""), delta(content="x"), FINISH, DONE]))
    assert texts == ["x"]
    spent = budget(trace.chain())
    assert "server" in spent.stages_ns
    assert not {"ingest", "inference", "return"} & set(spent.stages_ns)
    assert spent.e2e_without_inference_ns is None


def test_the_body_is_openai_with_the_prompt_cache_off(serve: Serve) -> None:
    bodies: list[dict[str, Any]] = []
    ask(serve(LLAMA_SERVER, bodies), Request("a", "plan", (yuyv_frame(),), max_tokens=5, grammar='root ::= "x"'))
    (body,) = bodies
    assert body["stream"] is True
    assert body["max_tokens"] == 5
    assert body["grammar"] == 'root ::= "x"'
    assert body["cache_prompt"] is False
    picture, text = body["messages"][0]["content"]
    assert picture["image_url"]["url"].startswith("data:image/jpeg;base64,/9j/")
    assert text == {"type": "text", "text": "plan"}
    assert "request_id" not in body


def test_cached_tokens_are_noticed_without_timings(serve: Serve) -> None:
    usage = event(choices=[], usage={"prompt_tokens": 9, "prompt_tokens_details": {"cached_tokens": 8}})
    _, trace = ask(serve([http_head(), delta(content="x"), FINISH, usage, DONE]))
    assert trace.facts["cache_n"] == 8


def test_comment_pings_and_odd_chunk_boundaries_do_no_harm(serve: Serve) -> None:
    whole = b": ping\n\n" + delta(content="キッチン") + b":\n\n" + delta(content="é") + FINISH + DONE
    texts, _ = ask(serve([http_head(), *(whole[i : i + 1] for i in range(len(whole)))]))
    assert texts == ["キッチン", "é"]


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ([http_head(), delta(content="x"), event(error={"message": "slot lost", "code": 500})], "broke off: slot lost"),
        ([http_head(), event(error="no memory")], "broke off: no memory"),
        ([http_head(), delta(content="x")], "before the answer was complete"),
        ([http_head()], "before the answer was complete"),
        ([http_head("401 Unauthorized", "application/json"), b'{"error":{"message":"bad key"}}'], "401: bad key"),
        ([http_head("429 Too Many Requests", "text/plain"), b"slow down"], "429: slow down"),
        ([http_head("503 Service Unavailable", "text/plain")], "503: nothing"),
        ([http_head(kind="application/json"), b'{"error":{"message":"no such model"}}'], "200: no such model"),
        ([http_head(), b"data: {not json}\n\n"], "not the dialect 'llama-server'"),
        ([http_head(), b"data: [1, 2]\n\n"], "not the dialect 'llama-server'"),
        (
            [b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nContent-Length: 99\r\n\r\n", FINISH],
            "broke the conn",
        ),
        ([b"SSH-2.0-OpenSSH_9.6\r\n"], "broke the connection"),
        ([], "broke the connection"),
    ],
)
def test_misbehaviour_is_a_failed_request_that_says_what(serve: Serve, script: Script, message: str) -> None:
    with pytest.raises(RequestFailed, match=message):
        ask(serve(script))


def test_a_connection_that_the_server_closed_is_opened_again(serve: Serve) -> None:
    """llama-server promises keep-alive and closes after each stream; the race with its closing is ours to mend."""
    head = LLAMA_SERVER[0].replace(b"Connection: close\r\n\r\n", b"Keep-Alive: timeout=5, max=100\r\n")
    whole = b"".join(LLAMA_SERVER[1:])
    chunked = [head + b"Transfer-Encoding: chunked\r\n\r\n", b"%x\r\n%s\r\n0\r\n\r\n" % (len(whole), whole)]
    client = open_client(wiring("http/as-deployed", url=serve(chunked), dialect="llama-server"))
    for number in range(20):
        assert len(list(client.request(Request(str(number), "plan"), Trace()))) == 2
    client.close()


def test_nobody_listening_is_a_dead_server() -> None:
    with pytest.raises(ServerDied, match=r"nothing answers at http://127\.0\.0\.1:9/"):
        ask("http://127.0.0.1:9")


def test_a_url_with_v1_is_understood(serve: Serve) -> None:
    texts, _ = ask(serve(LLAMA_SERVER) + "/v1/")
    assert texts == ["go", "_to"]
