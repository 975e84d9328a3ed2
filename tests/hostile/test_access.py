"""Who may ask: on loopback everybody or who has the key, off it nobody without a key unless that was asked for."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.harness.serving import engine_handler
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.testing.transport import ask, served, wiring
from s2a_bench.transport import open_client, open_server
from s2a_bench.transport.http.own import PATHS
from s2a_bench.types import Request

KEY = "sekret-0123456789"
ALL = "0.0.0.0:0"
CHAT = PATHS["as-deployed"]
BODY = {"messages": [{"role": "user", "content": "go on"}], "max_tokens": 2}


@pytest.fixture(scope="module", autouse=True)
def key_in_the_environment() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MY_KEY", KEY)
        yield


@contextmanager
def serving(address: str = "", **options: Any) -> Iterator[str]:
    """Serve echo; return the address on loopback."""
    handler = engine_handler(open_engine(EngineConfig(name="echo")))
    with served(wiring("http", address, **options), handler) as (server, _):
        yield server.address.replace(ALL[:-2], "127.0.0.1")


@pytest.fixture(scope="module")
def documented(key_in_the_environment: None) -> Iterator[str]:  # noqa: ARG001 - it is read there
    with serving(api_key_env="MY_KEY", api_docs=True) as url:
        yield url


def test_off_loopback_a_key_is_needed_or_none_is_asked_for() -> None:
    with pytest.raises(UsageError, match=r"`host`: others reach 0.0.0.0; .* `api_key_env`, .* `no_auth`"):
        open_server(wiring("http", ALL), engine_handler(open_engine(EngineConfig(name="echo"))))
    with serving(ALL, no_auth=True) as url:
        assert httpx.post(url + CHAT, json=BODY).status_code == 200
    with serving(ALL, api_key_env="MY_KEY") as url:
        assert httpx.post(url + CHAT, json=BODY).status_code == 401


def test_a_key_and_none_are_refused_together() -> None:
    with pytest.raises(UsageError, match=r"`no_auth` .* `api_key_env`"):
        wiring("http", no_auth=True, api_key_env="MY_KEY")


def test_a_key_that_is_not_there_is_told_before_anything_is_served() -> None:
    with pytest.raises(UsageError, match="`api_key_env`: the environment has no such variable"):
        open_server(wiring("http", api_key_env="NO_KEY"), engine_handler(open_engine(EngineConfig(name="echo"))))


@pytest.mark.parametrize(
    "headers",
    [
        [],
        [("authorization", "")],
        [("authorization", KEY)],
        [("authorization", f"Basic {KEY}")],
        [("authorization", f"Bearer {KEY[:-1]}")],
        [("authorization", f"Bearer {KEY}x")],
        [("authorization", "Bearer é")],
        [("authorization", f"Bearer {KEY}"), ("authorization", f"Bearer {KEY}")],
        [("x-api-key", KEY)],
    ],
)
@pytest.mark.parametrize("path", [*PATHS.values(), "/v1/models", "/openapi.json", "/nowhere"])
def test_without_the_key_only_health_is_open(path: str, headers: list[tuple[str, str]], documented: str) -> None:
    encoded = [(name, value.encode()) for name, value in headers]
    answer = httpx.post(documented + path, json=BODY, headers=encoded)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    assert "Bearer KEY" in answer.json()["error"]["message"]
    assert KEY not in answer.text
    assert httpx.get(documented + "/health").status_code == 200


def test_a_large_body_without_the_key_is_told_so_too() -> None:
    with serving(api_key_env="MY_KEY") as url, httpx.Client(timeout=60) as client:
        for _ in range(3):
            assert client.post(url + CHAT, content=bytes(30 << 20)).status_code == 401
        assert client.get(url + "/health").status_code == 200


def test_a_body_without_the_key_is_not_read() -> None:
    with serving(api_key_env="MY_KEY") as url:
        host, port = url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=20) as connection:
            connection.sendall(f"POST {CHAT} HTTP/1.1\r\nHost: a\r\nContent-Length: 60000000\r\n\r\n".encode())
            assert connection.recv(100).startswith(b"HTTP/1.1 401")


@pytest.mark.parametrize("variant", list(PATHS))
def test_our_own_client_sends_it(variant: str) -> None:
    with serving(api_key_env="MY_KEY") as url:
        for options in ({}, {"url": url}):
            if variant == "binary" and options:
                continue
            client = open_client(wiring(f"http/{variant}", url, api_key_env="MY_KEY", **options))
            try:
                assert len(ask(client, Request("a", "go on", max_tokens=2))[0]) == 2
            finally:
                client.close()
        stranger = open_client(wiring(f"http/{variant}", url))
        try:
            with pytest.raises(RequestFailed, match="answered 401"):
                ask(stranger, Request("a", "go on"))
        finally:
            stranger.close()


@pytest.mark.parametrize("path", ["/openapi.json", "/docs", "/redoc"])
def test_the_description_of_the_interface_is_off_unless_asked_for(path: str) -> None:
    with serving() as url:
        assert httpx.get(url + path).status_code == 404
    with serving(api_docs=True) as url:
        assert httpx.get(url + path).status_code == 200
