"""HTTP through a tap: what is seen of it, and that its bytes pass as they are."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from hashlib import sha256
from pkgutil import resolve_name
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from httptools import HttpParserError
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.watch.relay import ByteRelay
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.transport.http import HTTP, tap
from s2a_bench.transport.http.tap import HttpReader
from s2a_bench.transport.tap import FAILED, Seen, TapReader
from s2a_bench.types import Request, Token
from tests.servers.sockets import Received, chunk, head, kept_head, serving
from tests.servers.speakers import SPEAKERS, Speaker, compact, sse
from tests.waiting import until

CHAT = "/v1/chat/completions"
ASKED = {"messages": [{"role": "user", "content": "go"}], "stream": True, "max_tokens": 8}
Direction = tuple[bool, bytes]
UP, DOWN = True, False


class Tapped:
    """A relay before a server: its address, and what it saw and said."""

    def __init__(self, address: str, reader: Callable[[Callable[[Seen], None], set[str]], TapReader]) -> None:
        parts = urlsplit(address)
        listener = socket.create_server(("127.0.0.1", 0))
        self.address = parts._replace(netloc="{}:{}".format(*listener.getsockname())).geturl()
        self.seen: list[Seen] = []
        self.lines: list[str] = []
        server = (parts.hostname or "", parts.port or 0)
        self.relay = ByteRelay(listener, server, reader, lambda _, seen: self.seen.append(seen), self.lines.append)

    def after(self, count: int) -> list[Seen]:
        """Return what was seen, once it is ``count`` exchanges."""
        until(lambda: len(self.seen) >= count)
        assert (len(self.seen), self.lines) == (count, [])
        for seen in self.seen:
            times = [seen.request_ns, seen.sent_ns, seen.answer_ns, *seen.pieces_ns, seen.end_ns]
            assert seen.request_ns <= seen.answer_ns
            assert times[2:] == sorted(times[2:])
        return self.seen


@contextmanager
def tapped(
    address: str, reader: Callable[[Callable[[Seen], None], set[str]], TapReader] = HttpReader
) -> Iterator[Tapped]:
    made = Tapped(address, reader)
    thread = Thread(target=made.relay.serve)
    thread.start()
    try:
        yield made
    finally:
        made.relay.stop()
        thread.join()


def fed(reader: type[TapReader], parts: Iterable[Direction], step: int = 0) -> list[Seen]:
    """Feed a reader whole parts, or ``step`` bytes at a time, each 10 ns after the other; bytes take 1 ns."""
    seen: list[Seen] = []
    made, now = reader(seen.append, set()), 0
    for up, part in parts:
        for start in range(0, len(part), step or len(part) or 1):
            now += 10
            made.passed(part[start : start + (step or len(part))], now, now + 1, up=up)
    made.end()
    return seen


def alike(seen: list[Seen]) -> list[Any]:
    """Return what does not depend on how the bytes came."""
    timeless = [field.name for field in fields(Seen) if not field.name.endswith("_ns")]
    return [[len(each.pieces_ns), *(repr(getattr(each, name)) for name in timeless)] for each in seen]


def post(path: str, body: bytes, *more: str) -> bytes:
    lines = [f"POST {path} HTTP/1.1", "Host: a", f"Content-Length: {len(body)}", *more, "", ""]
    return "\r\n".join(lines).encode() + body


def whole(body: bytes, status: str = "200 OK", kind: str = "application/json", *more: str) -> bytes:
    lines = [f"HTTP/1.1 {status}", f"Content-Type: {kind}", f"Content-Length: {len(body)}", *more, "", ""]
    return "\r\n".join(lines).encode() + body


def delta(**values: Any) -> dict[str, Any]:
    return {"choices": [{"index": 0, "delta": values, "finish_reason": None}]}


TIMINGS = {"timings": {"prompt_n": 4, "prompt_ms": 30.5, "predicted_n": 2, "predicted_ms": 12.0}}
EVENTS = [
    delta(role="assistant", content=None),
    delta(reasoning_content="hm"),
    delta(content="le"),
    delta(content="ft"),
]
STREAM = [*map(sse, EVENTS), sse({"choices": [], **TIMINGS}), b"data: [DONE]\n\n"]


def streamed(_: Received) -> Iterator[bytes]:
    yield kept_head("text/event-stream")
    yield from (chunk(piece) for piece in [*STREAM, b""])


# real peers


def test_a_stream_and_an_answer_in_one_piece_on_one_connection_of_httpx() -> None:
    def reply(received: Received) -> Iterable[bytes]:
        return streamed(received) if received.json["stream"] else [whole(compact({**delta(), **TIMINGS}))]

    with serving(reply) as address, tapped(address) as tap_, httpx.Client(base_url=tap_.address) as client:
        for stream in (True, False):
            client.post(f"{CHAT}?key=secret", json={**ASKED, "stream": stream}).raise_for_status()
        first, second = tap_.after(2)
    assert first.what == second.what == f"POST {CHAT}"
    assert len(first.pieces_ns) == 3
    assert (first.infer_ms, second.infer_ms) == (30.5, 42.5)
    assert (first.observation, second.observation) == (ASKED, None)
    assert first.up_bytes == len(httpx.Request("POST", "http://a", json=ASKED).content)
    assert first.down_bytes == sum(map(len, STREAM))
    assert second.pieces_ns == []
    assert tap_.relay.totals.connections == 1


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort", "binary"])
def test_our_server_with_tokens(variant: str) -> None:
    with (
        served(wiring_of(f"http/{variant}"), RecordingHandler(["le", "ft", "up"])) as (server, _),
        tapped(server.address) as tap_,
    ):
        client = open_client(wiring_of(f"http/{variant}", tap_.address))
        for _ in range(2):
            ask(client, Request("r-1", "go", (yuyv_frame(),)))
        client.close()
        for seen in tap_.after(2):
            assert (len(seen.pieces_ns), seen.chunk, seen.error) == (3, None, "")


def test_curl_waits_for_100_continue_and_prints_the_events(tmp_path: Any) -> None:
    curl = shutil.which("curl") or pytest.skip("no curl")
    body = json.dumps({**ASKED, "more": "x" * (2 << 20)}).encode()  # above curl's limit for Expect
    (tmp_path / "body").write_bytes(body)
    wiring = wiring_of("http/best-effort")
    with served(wiring, RecordingHandler(["le", "ft"])) as (server, _), tapped(server.address) as tap_:
        url, data = f"{tap_.address}/best-effort{CHAT}", f"@{tmp_path / 'body'}"
        expect = ("-H", "Expect: 100-continue")
        printed = subprocess.run([curl, "-sN", *expect, "--data-binary", data, url], capture_output=True, check=True)
        (seen,) = tap_.after(1)
    assert printed.stdout.endswith(b"data: [DONE]\n\n")
    assert (seen.up_bytes, seen.down_bytes, len(seen.pieces_ns)) == (len(body), len(printed.stdout), 2)
    assert seen.observation["messages"] == ASKED["messages"]
    assert seen.sent_ns <= seen.answer_ns


def test_http_client_of_the_standard_library_gets_heads_errors_and_pages() -> None:
    def reply(received: Received) -> Iterable[bytes]:
        if received.method == "HEAD":
            return [whole(b"")[:-2].replace(b"Length: 0", b"Length: 99") + b"\r\n"]
        return [whole(compact({"error": {"message": "busy"}}), "503 No")] if "busy" in received.path else [whole(b"{}")]

    with serving(reply) as address, tapped(address) as tap_:
        peer = http.client.HTTPConnection(urlsplit(tap_.address).netloc)
        for method, path in (("GET", "/health"), ("HEAD", "/health"), ("GET", "/busy?token=abc"), ("GET", "/health")):
            peer.request(method, path)
            peer.getresponse().read()
        seen = tap_.after(4)
        peer.close()
    assert [each.what for each in seen] == ["GET /health", "HEAD /health", "GET /busy", "GET /health"]
    assert [each.error for each in seen] == ["", "", "HTTP 503", ""]
    assert [each.down_bytes for each in seen] == [2, 0, 28, 2]


def test_an_answer_without_a_length_ends_with_its_connection() -> None:
    with serving(lambda _: [head(), *STREAM[:4]]) as address, tapped(address) as tap_:
        httpx.post(tap_.address + CHAT, json=ASKED).raise_for_status()
        (seen,) = tap_.after(1)
    assert (len(seen.pieces_ns), seen.error, seen.down_bytes) == (3, "", sum(map(len, STREAM[:4])))
    assert seen.end_ns


def test_what_is_no_http_passes_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = "http://{}:{}".format(*server.getsockname())
        with tapped(address) as tap_:
            robot = socket.create_connection(("127.0.0.1", urlsplit(tap_.address).port or 0))
            accepted, _ = server.accept()
            with robot, accepted:
                for hello in (b"\x16\x03\x01 hello", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"):
                    robot.sendall(hello)
                    assert accepted.recv(100) == hello
                    accepted.sendall(b"well")
                    assert robot.recv(100) == b"well"
            until(lambda: tap_.seen)
    assert {seen.what for seen in tap_.seen} == {"turns"}
    assert "read by turns" in tap_.lines[0]


@pytest.mark.parametrize("valid", [True, False])
def test_the_bytes_are_the_same_with_and_without_the_tap(valid: bool) -> None:
    noise = np.random.default_rng(7).bytes(3 << 20)
    asked = b"".join(post(CHAT, noise[: 1 << shift]) for shift in range(4, 22)) if valid else noise
    answers = b"".join(whole(noise[: 1 << shift]) for shift in range(4, 22)) if valid else noise[::-1]

    def exchanged(peer: socket.socket, out: bytes) -> str:
        def send() -> None:
            peer.sendall(out)
            peer.shutdown(socket.SHUT_WR)

        sender = Thread(target=send)
        sender.start()
        came = sha256()
        while data := peer.recv(1 << 16):
            came.update(data)
        sender.join()
        return came.hexdigest()

    def digests(port: int) -> list[str]:
        there: list[str] = []

        def answer() -> None:
            accepted, _ = server.accept()
            with accepted:
                there.append(exchanged(accepted, answers))

        thread = Thread(target=answer)
        thread.start()
        with socket.create_connection(("127.0.0.1", port)) as robot:
            here = exchanged(robot, asked)
        thread.join()
        return [here, *there]

    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = server.getsockname()
        plain = digests(port)
        with tapped(f"http://{host}:{port}") as tap_:
            assert digests(urlsplit(tap_.address).port or 0) == plain
    assert plain == [sha256(answers).hexdigest(), sha256(asked).hexdigest()]


# recorded bytes

ACTION = {"__numpy__": "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA==", "dtype": "<f4", "shape": [7]}
LINES = b"".join(compact(each) + b"\n" for each in ({"message": {"content": "le"}}, {"message": {"content": "ft"}}))
OLLAMA = {"done": True, "total_duration": 9_000_000, "prompt_eval_duration": 2_000_000, "eval_duration": 5_000_000}
RECORDED: dict[str, tuple[list[Direction], list[Any]]] = {
    "pipelined": (
        [(UP, post("/a?k=1", b"12") + post("/b", b"345")), (DOWN, whole(b"[1]") + whole(b"[]", "404 No"))],
        [("POST /a", 2, 3, 0, (1, 1), None, ""), ("POST /b", 3, 2, 0, None, None, "HTTP 404")],
    ),
    "chunked both ways": (
        [
            (UP, b"POST /x HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + chunk(b"12") + chunk(b"3") + chunk(b"")),
            (DOWN, kept_head("application/json") + chunk(b'{"action":') + chunk(b"[[1,2],[3,4]]}") + chunk(b"")),
        ],
        [("POST /x", 3, 24, 0, (2, 2), None, "")],
    ),
    "only 1xx, then the answer": (
        [
            (UP, post(CHAT, b"", "Expect: 100-continue").replace(b"Length: 0", b"Length: 2")),
            (DOWN, b"HTTP/1.1 100 Continue\r\n\r\n"),
            (UP, b"{}"),
            (DOWN, b"HTTP/1.1 103 Early Hints\r\nLink: x\r\n\r\n" + whole(b"{}")),
        ],
        [(f"POST {CHAT}", 2, 2, 0, None, None, "")],
    ),
    "answered before the request's end": (
        [
            (UP, post("/big", b"1" * 9)[:-5]),
            (DOWN, whole(b"{}", "413 Large")),
            (UP, b"1" * 5 + post("/next", b"7")),
            (DOWN, whole(b"{}")),
        ],
        [("POST /big", 9, 2, 0, None, None, "HTTP 413"), ("POST /next", 1, 2, 0, None, None, "")],
    ),
    "json_numpy in a text": (
        [(UP, post("/act", b"{}")), (DOWN, whole(compact(json.dumps(ACTION))))],
        [("POST /act", 2, len(compact(json.dumps(ACTION))), 0, (1, 7), None, "")],
    ),
    "json_numpy": (
        [(UP, post("/act", b"{}")), (DOWN, whole(compact(ACTION)))],
        [("POST /act", 2, len(compact(ACTION)), 0, (1, 7), None, "")],
    ),
    "ollama": (
        [
            (UP, post("/api/chat", b"{}")),
            (DOWN, whole(LINES + compact(OLLAMA), kind="application/x-ndjson")),
            (UP, post("/api/chat", b"{}")),
            (DOWN, whole(compact(OLLAMA))),
        ],
        [
            ("POST /api/chat", 2, len(LINES + compact(OLLAMA)), 2, None, 2.0, ""),
            ("POST /api/chat", 2, len(compact(OLLAMA)), 0, None, 7.0, ""),
        ],
    ),
    "events of an unknown path, and no JSON": (
        [(UP, post("/v2", b"{}")), (DOWN, whole(b"data: 1\n\ndata: what?\n\ndata: {}\n\n", kind="text/event-stream"))],
        [("POST /v2", 2, 32, 3, None, None, "")],
    ),
    "an error in a stream": (
        [
            (UP, post(CHAT, b"{}")),
            (DOWN, whole(sse(delta(content="a")) + sse({"error": "full"}), kind="text/event-stream")),
        ],
        [(f"POST {CHAT}", 2, 102, 1, None, None, FAILED)],
    ),
    "compressed": (
        [(UP, post(CHAT, b"{}")), (DOWN, whole(b"\x1f\x8b??", "200 OK", "application/json", "Content-Encoding: gzip"))],
        [(f"POST {CHAT}", 2, 4, 0, None, None, "")],
    ),
    "cut off": (
        [(UP, post(CHAT, b"{}")), (DOWN, whole(b"{}" * 9)[:-3])],
        [(f"POST {CHAT}", 2, 15, 0, None, None, "the connection ended before the answer")],
    ),
    "an upgrade that the server ignores": (
        [
            (UP, b"GET / HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: h2c\r\n\r\n" + post("/x", b"1")),
            (DOWN, whole(b"{}") + whole(b"[]")),
        ],
        [("GET /", 0, 2, 0, None, None, ""), ("POST /x", 1, 2, 0, None, None, "")],
    ),
    "a failure of OpenVLA": (
        [(UP, post("/act", b"{}")), (DOWN, whole(b'"error"'))],
        [("POST /act", 2, 7, 0, None, None, FAILED)],
    ),
    "an answer that nobody asked for": ([(DOWN, whole(b"{}", "408 Late"))], []),
}


@pytest.mark.parametrize("step", [0, 1, 7])
@pytest.mark.parametrize("name", RECORDED)
def test_the_same_is_seen_however_the_bytes_come(name: str, step: int) -> None:
    parts, expected = RECORDED[name]
    seen = fed(HttpReader, parts, step)
    found = [(s.what, s.up_bytes, s.down_bytes, len(s.pieces_ns), s.chunk, s.infer_ms, s.error) for s in seen]
    assert found == expected


INFER_MS = {"llama-server": 97.5, "vllm": 31.5, "ollama": 100.0}
"""Up to the first token, as the speakers report it."""


@pytest.mark.parametrize("speaker", SPEAKERS, ids=lambda speaker: speaker.dialect)
def test_streams_of_all_dialects(speaker: Speaker) -> None:
    tokens = [Token(index, text, index) for index, text in enumerate(["le", "", "ft"])]
    body = b"".join([speaker.opening(), *map(speaker.token, tokens), speaker.closing(tokens)])
    (seen,) = fed(HttpReader, [(UP, post(speaker.path, b"{}")), (DOWN, whole(body, kind=speaker.kind))], 5)
    path = speaker.path.partition("?")[0]
    assert seen.what == f"POST {'/v1beta/models/*' if speaker.dialect == 'gemini' else path}"
    pieces = 4 if speaker.dialect == "gemini" else 2  # of a path that is not known each message is one
    assert (len(seen.pieces_ns), seen.infer_ms, seen.error) == (pieces, INFER_MS.get(speaker.dialect), "")


def test_the_transport_declares_its_reader() -> None:
    assert resolve_name(HTTP.reader) is HttpReader


def test_times_are_those_of_first_and_last_bytes() -> None:
    asked, answer = post("/x", b"12"), whole(b"[]")
    (seen,) = fed(HttpReader, [(UP, asked), (DOWN, b"HTTP/1.1 100 Go\r\n\r\n"), (DOWN, answer)], 1)
    answer_at = (len(asked) + len(b"HTTP/1.1 100 Go\r\n\r\n")) * 10
    assert (seen.request_ns, seen.sent_ns) == (10, len(asked) * 10 + 1)
    assert (seen.answer_ns, seen.end_ns) == (answer_at + 10, answer_at + len(answer) * 10 + 1)


def test_only_the_first_request_of_a_kind_is_decoded() -> None:
    parts = [(UP, post("/x", b"[1]")), (DOWN, whole(b"{}"))] * 2
    parts += [(UP, post("/y", b"no JSON")), (DOWN, whole(b"{}"))]
    assert [seen.observation for seen in fed(HttpReader, parts)] == [[1], None, None]


@pytest.mark.parametrize("up", [True, False])
@pytest.mark.parametrize(
    "start", [b"", b"GET /x HTTP/1.1\r\nA: ", b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"]
)
def test_a_head_that_does_not_end_is_given_up(start: bytes, up: bool) -> None:
    with pytest.raises((ValueError, HttpParserError)):
        fed(HttpReader, [(up, start), *[(up, b"x" * 65536)] * 30])


def test_a_stream_without_a_message_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tap, "DECODED_BYTES", 1000)
    body = b"data: " + b"x" * 2000 + b"\n\n" + sse(delta(content="a"))
    parts = [(UP, post(CHAT, b"{}")), (DOWN, whole(body, kind="text/event-stream"))]
    (seen,) = fed(HttpReader, parts, 100)
    assert (seen.pieces_ns, seen.down_bytes, seen.error) == ([], len(body), "")


@given(parts=st.lists(st.tuples(st.booleans(), st.binary(max_size=99)), max_size=9), name=st.sampled_from([*RECORDED]))
def test_odd_bytes_raise_or_are_seen_alike(name: str, parts: list[Direction]) -> None:
    recorded = [*RECORDED[name][0], *parts]
    found = []
    for step in (0, 1):
        try:
            found.append(alike(fed(HttpReader, recorded, step)))
        except Exception as error:  # noqa: BLE001 - the relay catches any
            found.append([type(error)])
    assert found[0] == found[1]
