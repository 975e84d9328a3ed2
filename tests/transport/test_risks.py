"""`doctor --url`: findings about external servers, without a request to their models."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Thread

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport import risks
from s2a_bench.transport.risks import examine


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


ANSWER = b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}"


def found(url: str) -> dict[str, Finding]:
    return {finding.code: finding for finding in examine(url)}


@pytest.mark.parametrize(
    ("scheme", "exposed", "others"),
    [
        ("grpc", "lerobot's server unpickles what any client sends (CVE-2026-25874)", {"sleep", "filter"}),
        ("tcp", "GR00T N1 and early N1.7 unpickle what any client sends", set()),
    ],
)
def test_what_unpickles_is_told_of_without_a_byte_to_it(scheme: str, exposed: str, others: set[str]) -> None:
    with answering(b"") as (place, heard):
        findings = found(f"{scheme}://{place}")
    assert (findings["access"].level, findings["access"].message) == ("advice", f"127.0.0.1: {exposed}")
    assert findings.keys() & {"sleep", "filter"} == others
    assert findings["server"].level == "state"
    assert heard == [b""]


def test_a_server_of_this_machine_is_no_risk() -> None:
    with answering(ANSWER) as (place, heard):
        findings = found(f"http://{place}")
    assert [(each.level, each.message) for each in findings.values()] == [("state", "127.0.0.1 answers")]
    assert heard[0].startswith(b"GET /v1/models HTTP/1.1")


def test_off_this_machine_it_is_a_warning_that_names_encryption(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not risks.is_local("192.168.0.5")
    monkeypatch.setattr(risks, "is_local", lambda _host: False)
    with answering(ANSWER) as (place, _):
        access = found(f"http://{place}")["access"]
        port = place.rpartition(":")[2]
    assert (access.level, access.message) == ("warning", "127.0.0.1: not encrypted, so a key can be read on the way")
    assert access.fix.endswith(f"ssh -L {port}:127.0.0.1:{port} 127.0.0.1")
    assert "access" not in found(f"https://{place}")


@pytest.mark.parametrize(
    ("head", "code"),
    [
        (b"1.1 200 OK", ""),
        (b"1.1 200 OK\r\nkeep-alive: timeout=5, max=100", "idle"),
        (b"1.1 200 OK\r\nConnection: close", "connections"),
        (b"1.0 200 OK", "connections"),
        (b"1.0 404 No", ""),
    ],
)
def test_an_http_server_that_closes_connections_is_told_of(head: bytes, code: str) -> None:
    with answering(b"HTTP/" + head + b"\r\ncontent-length: 2\r\n\r\n{}") as (place, _):
        findings = found(f"http://{place}")
    assert findings.keys() - {"server"} == {code} - {""}
    assert code != "idle" or "after 5 s of silence" in findings["idle"].message


@pytest.mark.parametrize("url", ["foo://x", "http://", "grpc://:80", "http://[x", "http://a:99999999", "x", ""])
def test_what_is_no_url_of_a_server_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match=r"^`url`: (that is not a|'.*' should look like http://192.168.0.5:8000: )"):
        examine(url)


def test_nobody_there_is_an_error_in_one_line() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    for scheme in ("http", "https", "ws", "wss", "tcp", "grpc"):
        finding = found(f"{scheme}://127.0.0.1:{port}")["server"]
        assert (finding.level, finding.message.isprintable()) == ("error", True)
        assert finding.message.startswith("127.0.0.1 does not answer: ")


def test_what_a_server_says_is_one_short_line() -> None:
    with answering(b"HTTP/1.1 403 a\x1b[31m" + b"c" * 500 + b"\r\ncontent-length: 0\r\n\r\n") as (place, _):
        finding = found(f"ws://{place}")["server"]
    assert finding.level == "state"
    assert finding.message.startswith(f"127.0.0.1 refuses: ws://{place}")
    assert finding.message.isprintable()
    assert len(finding.message) < 150
