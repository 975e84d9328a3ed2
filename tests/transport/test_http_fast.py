"""What HTTP allows on a connection of the server of best effort and binary, and what that refuses; limits of both."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import pytest

from s2a_bench.testing.transport import RecordingHandler, served, wiring_of
from s2a_bench.transport import Handler, serving
from s2a_bench.transport.http.native import PATHS
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.transport.serving import InFlight
from tests.waiting import until

PATH = PATHS["best-effort"]


@contextmanager
def connected(
    handler: Handler | None = None, limits: Limits = LIMITS, variant: str = "best-effort"
) -> Iterator[socket.socket]:
    """Serve, and connect, for as long as the context lasts."""
    with ExitStack() as stack:
        wiring = replace(wiring_of(f"http/{variant}"), limits=limits)
        server, _ = stack.enter_context(served(wiring, handler or RecordingHandler(["go", "_to"])))
        host, port = server.address.removeprefix("http://").split(":")
        yield stack.enter_context(socket.create_connection((host, int(port)), timeout=20))


def body(prompt: str = "plan", **more: object) -> bytes:
    return json.dumps({"messages": [{"role": "user", "content": prompt}], **more}).encode()


def request(data: bytes, *headers: str, version: str = "1.1", path: str = PATH) -> bytes:
    lines = [
        f"POST {path} HTTP/{version}",
        "Host: localhost",
        "Content-Type: application/json",
        *(headers or (f"Content-Length: {len(data)}",)),
    ]
    return "\r\n".join([*lines, "", ""]).encode() + data


def read(connection: socket.socket) -> tuple[int, bytes]:
    """Read one answer with a length; return its status and body."""
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        piece = connection.recv(1)
        assert piece, head
        head += piece
    size = next(int(line.split(b":")[1]) for line in head.split(b"\r\n") if line.startswith(b"content-length"))
    return int(head.split()[1]), connection.recv(size, socket.MSG_WAITALL)


def rest_of(connection: socket.socket) -> bytes:
    """Read until the server closes."""
    data = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(65536):
            data += piece
    return data


def answered(answer: tuple[int, bytes]) -> str:
    status, data = answer
    assert status == 200
    text: str = json.loads(data)["choices"][0]["message"]["content"]
    return text


def slices(data: bytes, size: int) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


def of_every_path() -> list[bytes]:
    header = 'S2A-Request: {"prompt": "a"}'
    bodies = {path: b"" if path == PATHS["binary"] else body() for path in PATHS.values()}
    return [request(data, header, f"Content-Length: {len(data)}", path=path) for path, data in bodies.items()]


LARGE, UPGRADE = body("a" * 100_000), ("Upgrade: h2c", "Connection: Upgrade")


@pytest.mark.parametrize(
    ("pieces", "answers"),
    [
        (slices(request(body("a" * 200)), 30), 1),
        ([*of_every_path(), *of_every_path()], 6),
        ([request(body()) * 2 + request(LARGE) * 3 + request(body())[:-1], request(body())[-1:]], 6),
        ([request(body(), f"Content-Length: {len(body())}", *UPGRADE)], 1),
    ],
    ids=["in pieces", "for all paths", "together", "an upgrade, which is ignored"],
)
def test_requests_of_a_connection_are_answered_in_order(pieces: list[bytes], answers: int) -> None:
    with connected() as connection:
        for piece in pieces:
            connection.sendall(piece)
            time.sleep(0.001)
        assert [answered(read(connection)) for _ in range(answers)] == ["go_to"] * answers


def test_who_expects_it_is_told_to_go_on() -> None:
    data = body()
    with connected() as connection:
        connection.sendall(request(b"", f"Content-Length: {len(data)}", "Expect: 100-continue"))
        assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
        connection.sendall(data)
        assert answered(read(connection)) == "go_to"


@pytest.mark.parametrize("stream", [True, False])
def test_http_1_0_has_no_chunks_and_ends_with_the_connection(stream: bool) -> None:
    with connected() as connection:
        connection.sendall(request(body(stream=stream), version="1.0"))
        head, _, answer = rest_of(connection).partition(b"\r\n\r\n")
        assert b"chunked" not in head
        assert answer.endswith(b"data: [DONE]\n\n") if stream else json.loads(answer)


@pytest.mark.parametrize(
    ("data", "status", "says"),
    [
        (request(b"", "Transfer-Encoding: chunked") + b"0\r\n\r\n", 411, "Content-Length"),
        (request(b"", "Content-Length: 3", "Content-Length: 5"), 400, "Content-Length"),
        (b"CONNECT a:80 HTTP/1.1\r\nHost: localhost\r\n\r\n", 404, "POST to one of"),
        (b"\x16\x03\x01\r\n\r\n", 400, "not an HTTP request"),
        (b"\r\n\r\n", 400, "not an HTTP request"),
        (request(b"", "a: " + "b" * 70_000), 431, "bytes of headers"),
    ],
)
def test_what_is_not_taken_is_told_in_one_line_and_hung_up_on(
    data: bytes, status: int, says: str, caplog: pytest.LogCaptureFixture
) -> None:
    with connected() as connection:
        connection.sendall(data)
        got, answer = read(connection)
        assert got == status
        assert says in json.loads(answer)["error"]["message"]
        assert rest_of(connection) == b""
    assert caplog.text == ""


def test_headers_that_stop_end() -> None:
    with connected(limits=Limits(head_s=0.1)) as connection:
        connection.sendall(request(b"")[:30])
        assert read(connection)[0] == 408


def test_as_deployed_uvicorn_ends_a_head_that_is_too_long() -> None:
    with connected(limits=Limits(header_kib=4), variant="as-deployed") as connection:
        connection.sendall(request(b"", "a: " + "b" * 5000).removesuffix(b"\r\n"))
        assert b" 400 " in rest_of(connection)[:20]


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
class TestLimits:
    def test_an_idle_connection_is_kept(self, variant: str) -> None:
        with connected(limits=Limits(head_s=0.1, body_s=0.1), variant=variant) as connection:
            for _ in range(2):
                time.sleep(0.3)
                connection.sendall(request(body(), path=PATHS[variant]))
                assert answered(read(connection)) == "go_to"

    def test_a_slow_body_ends(self, variant: str) -> None:
        with connected(limits=Limits(body_s=0.3), variant=variant) as connection:
            connection.sendall(request(b" " * 500_000, "Content-Length: 1000000", path=PATHS[variant]))
            assert read(connection)[0] == 408
            assert rest_of(connection) == b""

    def test_an_announced_body_is_refused_before_it_is_read(self, variant: str) -> None:
        with connected(limits=Limits(body_mib=1), variant=variant) as connection:
            connection.sendall(request(b"", "Content-Length: 2000000", path=PATHS[variant]))
            status, answer = read(connection)
            assert status == 413
            assert "larger than 1048576 bytes" in json.loads(answer)["error"]["message"]
            connection.shutdown(socket.SHUT_WR)
            assert rest_of(connection) == b""

    def test_bytes_under_way_are_counted_over_all_connections_and_given_back(
        self, variant: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[InFlight] = []
        monkeypatch.setattr(serving, "InFlight", lambda limits: made.append(InFlight(limits)) or made[0])
        data = body("a" * 600_000)
        whole = request(data, path=PATHS[variant])
        with connected(limits=Limits(in_flight_mib=1), variant=variant) as first:
            first.sendall(whole[:-1])
            until(lambda: made[0].bytes > 500_000)
            with socket.create_connection(first.getpeername(), timeout=20) as second:
                second.sendall(whole[:-1])
                answer = rest_of(second)
                assert b" 503 " in answer[:20]
                assert b"retry-after: 1\r\n" in answer
            until(lambda: made[0].bytes < 610_000)
            first.sendall(data[-1:])
            assert answered(read(first)) == "go_to"
            for _ in range(3):
                first.sendall(whole)
                assert answered(read(first)) == "go_to"
