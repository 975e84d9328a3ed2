"""What HTTP allows on a connection whose requests never reach the application: best effort and binary."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from threading import Event, Thread

import pytest

from s2a_bench.testing.transport import Recorder, served, wiring
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, open_server
from s2a_bench.transport.http.own import PATHS
from s2a_bench.transport.limits import LIMITS, MIB, Limits
from s2a_bench.types import Request, Token

PATH = PATHS["best-effort"]


@contextmanager
def connected(handler: Handler | None = None, limits: Limits = LIMITS) -> Iterator[socket.socket]:
    """Serve, and connect, for as long as the context lasts."""
    with ExitStack() as stack:
        told = replace(wiring("http"), limits=limits)
        server, _ = stack.enter_context(served(told, handler or Recorder(["go", "_to"])))
        host, port = server.address.removeprefix("http://").split(":")
        yield stack.enter_context(socket.create_connection((host, int(port)), timeout=20))


def body(prompt: str = "plan", **more: object) -> bytes:
    return json.dumps({"messages": [{"role": "user", "content": prompt}], **more}).encode()


def request(data: bytes, *headers: str, version: str = "1.1", path: str = PATH) -> bytes:
    lines = [f"POST {path} HTTP/{version}", "Host: a", *(headers or (f"Content-Length: {len(data)}",))]
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


def said(answer: tuple[int, bytes]) -> str:
    status, data = answer
    assert status == 200
    text: str = json.loads(data)["choices"][0]["message"]["content"]
    return text


@pytest.mark.parametrize("size", [1, 100_000, 3_000_000])
def test_a_kept_connection_is_answered_again_and_again(size: int) -> None:
    with connected() as connection:
        for _ in range(3):
            connection.sendall(request(body("a" * size)))
            assert said(read(connection)) == "go_to"


@pytest.mark.parametrize("cut", [1, 30, 130, 200])
def test_a_request_may_come_in_pieces(cut: int) -> None:
    data = request(body("a" * 200))
    with connected() as connection:
        for at in range(0, len(data), cut):
            connection.sendall(data[at : at + cut])
            time.sleep(0.001)
        assert said(read(connection)) == "go_to"


def test_a_body_may_come_in_chunks() -> None:
    data = body("a" * 100)
    chunks = b"".join(b"%x\r\n%b\r\n" % (len(part), part) for part in (data[:50], data[50:])) + b"0\r\n\r\n"
    with connected() as connection:
        for _ in range(2):
            connection.sendall(request(chunks, "Transfer-Encoding: chunked"))
            assert said(read(connection)) == "go_to"


def test_who_expects_it_is_told_to_go_on() -> None:
    data = body()
    with connected() as connection:
        connection.sendall(request(b"", f"Content-Length: {len(data)}", "Expect: 100-continue"))
        assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
        connection.sendall(data)
        assert said(read(connection)) == "go_to"


@pytest.mark.parametrize("stream", [True, False])
def test_http_1_0_has_no_chunks_and_ends_with_the_connection(stream: bool) -> None:
    with connected() as connection:
        connection.sendall(request(body(stream=stream), version="1.0"))
        head, _, answer = rest_of(connection).partition(b"\r\n\r\n")
        assert b"chunked" not in head
        assert answer.endswith(b"data: [DONE]\n\n") if stream else json.loads(answer)


def test_the_application_and_the_lane_share_a_connection() -> None:
    with connected() as connection:
        for path in (*PATHS.values(), *PATHS.values()):
            header = 'S2A-Request: {"prompt": "a"}'
            data = b"" if path == PATHS["binary"] else body()
            length, kind = f"Content-Length: {len(data)}", "Content-Type: application/json"
            connection.sendall(request(data, header, length, kind, path=path))
            assert said(read(connection)) == "go_to"


class Slow:
    """Answers when told."""

    def __init__(self) -> None:
        self.began, self.go = Event(), Event()

    def __call__(self, _request: Request, _trace: Trace) -> Generator[Token, None, None]:
        self.began.set()
        self.go.wait(20)
        yield Token(0, "go")


def test_a_request_that_comes_before_the_answer_is_kept() -> None:
    slow = Slow()
    with connected(slow) as connection:
        connection.sendall(request(body("first")))
        assert slow.began.wait(20)
        connection.sendall(request(body("a" * 300_000)))
        slow.go.set()
        assert said(read(connection)) == "go"
        assert said(read(connection)) == "go"


def test_one_that_comes_with_the_other_is_not_answered_but_hung_up_on() -> None:
    with connected() as connection:
        connection.sendall(request(body("", stream=False)) * 2)
        assert rest_of(connection).count(b"HTTP/1.1 200 OK") in {1, 2}  # 2: the network parted them


def test_stopping_in_the_middle_of_an_answer_hangs_up() -> None:
    slow = Slow()
    server = open_server(wiring("http"), slow)
    thread = Thread(target=server.serve)
    thread.start()
    host, port = server.address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(request(body(stream=True)))
        assert slow.began.wait(20)
        server.stop()
        assert rest_of(connection) == b""
    slow.go.set()
    thread.join(20)
    assert not thread.is_alive()


class TestLimits:
    def test_a_body_that_says_that_it_is_too_large_is_refused_unread(self) -> None:
        with connected(limits=Limits(body_mib=1000 / MIB)) as connection:
            connection.sendall(request(b"", "Content-Length: 1001"))
            assert read(connection)[0] == 413

    def test_a_body_that_does_not_say_is_counted(self) -> None:
        with connected(limits=Limits(body_mib=1000 / MIB)) as connection:
            connection.sendall(request(b"3e9\r\n" + bytes(1001) + b"\r\n", "Transfer-Encoding: chunked"))
            assert read(connection)[0] == 413

    @pytest.mark.parametrize("sent", [b"", b"{", b" " * 500_000])
    def test_a_slow_body_ends(self, sent: bytes) -> None:
        with connected(limits=Limits(body_s=0.3)) as connection:
            connection.sendall(request(sent, "Content-Length: 1000000"))
            assert read(connection)[0] == 408

    def test_bytes_under_way_are_counted_over_all_connections_and_given_back(self) -> None:
        data = body("a" * 600_000)
        with connected(limits=Limits(in_flight_mib=1)) as first:
            first.sendall(request(data)[:-1])
            time.sleep(0.2)
            with socket.create_connection(first.getpeername(), timeout=20) as second:
                second.sendall(request(data)[:-1])
                assert read(second)[0] == 503
            time.sleep(0.2)
            first.sendall(data[-1:])
            assert said(read(first)) == "go_to"
            for _ in range(3):
                first.sendall(request(data))
                assert said(read(first)) == "go_to"

    @pytest.mark.parametrize("stream", [True, False])
    def test_who_waits_too_long_for_the_engine_is_told(self, stream: bool) -> None:
        slow = Slow()
        with connected(slow, Limits(answer_s=0.5)) as first:
            first.sendall(request(body("first")))
            assert slow.began.wait(20)
            with socket.create_connection(first.getpeername(), timeout=20) as second:
                second.sendall(request(body("second", stream=stream)))
                status, answer = read(second)
                assert status == 504
                assert "waiting for the engine" in json.loads(answer)["error"]["message"]
            slow.go.set()
