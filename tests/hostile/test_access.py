"""Servers listen on loopback; off it they require a key; pages in a browser and foreign names are refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import httpx
import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of
from s2a_bench.transport import open_client, open_server
from s2a_bench.transport.http.native import PATHS
from s2a_bench.types import Request
from tests.hostile.peers import connect, sends
from tests.hostile.wires.websocket import upgrade

KEY = "sekret-0123456789"
ON_PORTS = ("http/as-deployed", "http/best-effort", "http/binary", "websocket/openpi", "zmq/gr00t")
WEB = ("http/as-deployed", "http/best-effort", "websocket/openpi")

on_ports = pytest.mark.parametrize("name", ON_PORTS)


def acting(name: str) -> RecordingHandler:
    """Return a handler that answers with three pieces."""
    return RecordingHandler(["go "] * 3 if name.startswith("http") else [[place / 8] for place in range(3)])


@pytest.fixture
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_KEY", KEY)


@contextmanager
def serving(name: str, **options: Any) -> Iterator[str]:
    with served(wiring_of(name, **options), acting(name)) as (server, _):
        yield server.address


@on_ports
def test_unless_told_otherwise_a_server_is_on_loopback(name: str) -> None:
    with serving(name) as address:
        assert address.partition("//")[2].startswith("127.0.0.1:")


@on_ports
def test_off_this_machine_a_key_is_needed_or_none_is_asked_for(name: str) -> None:
    handler = acting(name)
    with pytest.raises(UsageError, match=r"`host`: others reach 0.0.0.0; .*`api_key_env`, .*`no_auth`"):
        open_server(wiring_of(name, "0.0.0.0:0"), handler)
    with pytest.raises(UsageError, match=r"`no_auth` .* `api_key_env`"):
        wiring_of(name, no_auth=True, api_key_env="MY_KEY")
    with pytest.raises(UsageError, match="`api_key_env`: the environment has no such variable"):
        open_server(wiring_of(name, api_key_env="NO_KEY"), handler)
    with served(wiring_of(name, "0.0.0.0:0", no_auth=True), handler) as (server, _):
        assert server.address


@on_ports
def test_a_key_is_sent_and_who_has_none_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_KEY", "s3cret-robot-key")
    handler = acting(name)
    with served(wiring_of(name, api_key_env="MY_KEY"), handler) as (server, _):
        with closing(open_client(wiring_of(name, server.address, api_key_env="MY_KEY"))) as client:
            assert len(ask(client, Request("a", "go"))[0]) == 3
        with (
            closing(open_client(wiring_of(name, server.address))) as stranger,
            pytest.raises(RequestFailed, match=r"401|Unauthorized") as refused,
        ):
            ask(stranger, Request("b", "go"))
        assert "s3cret" not in str(refused.value)
    assert len(handler.requests) == 1


@pytest.mark.usefixtures("key")
@pytest.mark.parametrize("name", ["http/as-deployed", "http/binary"])
def test_without_the_key_only_health_is_open(name: str) -> None:
    wrong = ([], [f"Bearer {KEY[:-1]}"], [f"Bearer {KEY}"] * 2)
    with serving(name, api_key_env="MY_KEY", api_docs=True) as url:
        for path in (*PATHS.values(), "/v1/models", "/openapi.json", "/nowhere"):
            for keys in wrong:
                headers = [("authorization", each) for each in keys]
                answer = httpx.post(url + path, json={"messages": []}, headers=headers)
                assert (answer.status_code, path, keys) == (401, path, keys)
                assert answer.headers["www-authenticate"] == "Bearer"
                assert "Bearer KEY" in answer.json()["error"]["message"]
                assert KEY not in answer.text
        assert httpx.get(url + "/health").status_code == 200


@pytest.mark.usefixtures("key")
@pytest.mark.parametrize("name", ["http/as-deployed", "http/binary"])
def test_a_body_without_the_key_is_not_read(name: str) -> None:
    with serving(name, api_key_env="MY_KEY") as url, connect(wiring_of("http", url)) as connection:
        head = f"POST {PATHS['as-deployed']} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000000\r\n\r\n"
        connection.sendall(head.encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 401")


@pytest.mark.parametrize("name", WEB)
@pytest.mark.parametrize("header", ["Origin: https://example.org", "Origin: null", "Host: example.com"])
def test_a_page_in_a_browser_and_a_name_that_was_rebound_are_refused(name: str, header: str) -> None:
    path = PATHS.get(name.partition("/")[2], "/")
    plain = upgrade() if name == "websocket/openpi" else f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    named = plain.replace(b"Host: localhost\r\n", b"" if header.startswith("Host") else b"Host: localhost\r\n")
    refused = named.removesuffix(b"\r\n") + f"{header}\r\n\r\n".encode()
    with serving(name) as url:
        assert sends(refused)(wiring_of(name, url), "HTTP/1.1 403 ").startswith("HTTP/1.1 403 ")
        assert not sends(plain)(wiring_of(name, url), "HTTP/1.1 ...").startswith("HTTP/1.1 403 ")
