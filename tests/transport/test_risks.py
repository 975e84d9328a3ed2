"""`doctor --url`: findings about external servers, without a request to their models."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Thread

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.machine.doctor import Finding
from s2a_bench.plugins.policy_servers.grpc.client import PREFACE
from s2a_bench.testing.transport import RecordingHandler, served, wiring_of
from s2a_bench.transport import risks
from s2a_bench.transport.risks import examine, printable
from tests.servers.sockets import Received, head, serving

SETTINGS = bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))


@contextmanager
def answering(reply: bytes) -> Iterator[tuple[str, list[bytes]]]:
    """A server of one connection: its place, and what it heard."""
    heard: list[bytes] = []
    with closing(socket.create_server(("127.0.0.1", 0))) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                heard.append(connection.recv(4096))
                connection.sendall(reply)

        thread = Thread(target=serve, daemon=True)
        thread.start()
        yield f"127.0.0.1:{server.getsockname()[1]}", heard
        thread.join(10)


def found(url: str) -> dict[str, Finding]:
    return {finding.code: finding for finding in examine(url)}


def test_grpc_is_told_of_without_calling_a_method() -> None:
    with answering(SETTINGS) as (place, heard):
        findings = found(f"grpc://{place}")
    assert findings["access"].level == "warning"
    assert "no key, unpickles what it receives if it is lerobot's" in findings["access"].message
    assert {"access", "sleep", "filter"} == set(findings)
    assert heard == [PREFACE]


@pytest.mark.parametrize("reply", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\0" * 9])
def test_what_speaks_no_grpc_is_an_error(reply: bytes) -> None:
    with answering(reply) as (place, _):
        assert found(f"grpc://{place}")["server"].message == "the server does not speak gRPC"


def test_a_server_of_models_without_a_key_is_told_of() -> None:
    with served(wiring_of("http"), RecordingHandler(["x"])) as (server, _):
        findings = found(server.address)
    assert [(each.level, each.message) for each in findings.values()] == [("advice", "127.0.0.1: no key")]


def test_off_this_machine_it_is_a_warning_that_names_encryption(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(risks, "is_local", lambda _host: False)
    body = b'{"data": [{"id": "a"}]}'
    with answering(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%b" % (len(body), body)) as (place, _):
        findings = found(f"http://{place}")
        port = place.rpartition(":")[2]
    assert (findings["access"].level, findings["access"].message) == ("warning", "127.0.0.1: not encrypted, no key")
    assert findings["access"].fix.endswith(f"ssh -L {port}:127.0.0.1:{port} 127.0.0.1")


@pytest.mark.parametrize(
    ("replies", "is_open"),
    [
        ([("200 OK", '"error"')], True),
        ([("500 Internal Server Error", '{"error": "image"}')], True),
        ([("401 Unauthorized", "{}")], False),
        ([("422 Unprocessable Entity", '{"detail": [{"loc": ["header", "authorization"]}]}')], False),  # as FastAPI
        ([], False),
    ],
)
def test_an_act_that_answers_anyone_is_told_of(replies: list[tuple[str, str]], is_open: bool) -> None:
    """As vla-scripts/deploy.py of TRI-ML/prismatic-vlms at c43b6366: POST alone, and an error in words."""
    posted: list[bytes] = []

    def deploy(received: Received) -> list[bytes]:
        status, body = "404 Not Found", "{}"
        if received.path == "/act" and replies:
            status = "405 Method Not Allowed"
            if received.method == "POST":
                posted.append(received.body)
                ((status, body),) = replies
        return [head(status, kind="application/json") + body.encode()]

    with serving(deploy) as url:
        for each in (url, f"{url}/act"):
            findings = found(each)
            assert ("access" in findings) == is_open
            assert ("server" in findings) == (not is_open)
    assert posted == [b"{}"] * 2 * len(replies)


def test_an_http_server_that_closes_idle_connections_is_told_of() -> None:
    head = b"HTTP/1.1 200 OK\r\nkeep-alive: timeout=5, max=100\r\ncontent-length: 2\r\n\r\n{}"
    with answering(head) as (place, _):
        assert "after 5 s of silence" in found(f"http://{place}")["idle"].message


@pytest.mark.parametrize(
    ("head", "closes"),
    [(b"1.1 200 OK", False), (b"1.1 200 OK\r\nConnection: close", True), (b"1.0 200 OK", True), (b"1.0 404 No", False)],
)
def test_an_http_server_that_closes_after_each_answer_is_told_of(head: bytes, closes: bool) -> None:
    with answering(b"HTTP/" + head + b"\r\ncontent-length: 2\r\n\r\n{}") as (place, _):
        assert ("connections" in found(f"http://{place}")) == closes


def test_nobody_there_is_one_line() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    for scheme in ("http", "grpc"):
        assert found(f"{scheme}://127.0.0.1:{port}")["server"].level == "error"


def test_a_server_that_breaks_off_is_one_line() -> None:
    with answering(b"") as (place, _):
        assert found(f"tcp://{place}")["server"].level == "error"


@pytest.mark.parametrize("url", ["foo://x", "http://", "grpc://:80", "http://[x", "http://a:99999999", "x", ""])
def test_what_is_no_url_of_a_server_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match=r"^`url`: (that is no URL|'.*' should look like http://192.168.0.5:8000: )"):
        examine(url)


def test_what_servers_say_is_one_short_line() -> None:
    assert printable("a\nb\x1b" + "c" * 500) == "a?b?" + "c" * 116
