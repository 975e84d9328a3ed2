"""Access to an HTTP server with a key, and the refusals of other clients."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest

from s2a_bench.harness.serving import engine_handler
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.testing.transport import served, wiring_of
from s2a_bench.transport.http.native import PATHS

KEY = "sekret-0123456789"
CHAT = PATHS["as-deployed"]
BODY = {"messages": [{"role": "user", "content": "go on"}], "max_tokens": 2}


@pytest.fixture(scope="module", autouse=True)
def key_in_the_environment() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MY_KEY", KEY)
        yield


@contextmanager
def serving(variant: str = "as-deployed", **options: Any) -> Iterator[str]:
    """Serve echo for as long as the context lasts."""
    handler = engine_handler(open_engine(EngineConfig(name="echo")))
    with served(wiring_of(f"http/{variant}", **options), handler) as (server, _):
        yield server.address


@pytest.fixture(scope="module", params=["as-deployed", "binary"])
def documented(request: pytest.FixtureRequest, key_in_the_environment: None) -> Iterator[str]:  # noqa: ARG001 - read there
    with serving(variant=request.param, api_key_env="MY_KEY", api_docs=True) as url:
        yield url


@pytest.mark.parametrize(
    "headers",
    [
        [],
        [("authorization", f"Bearer {KEY[:-1]}")],
        [("authorization", f"Bearer {KEY}"), ("authorization", f"Bearer {KEY}")],
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


@pytest.mark.parametrize("variant", ["as-deployed", "binary"])
def test_a_body_without_the_key_is_not_read(variant: str) -> None:
    with serving(variant=variant, api_key_env="MY_KEY") as url:
        host, port = url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=20) as connection:
            connection.sendall(f"POST {CHAT} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000000\r\n\r\n".encode())
            assert connection.recv(100).startswith(b"HTTP/1.1 401")
