"""Who may ask our HTTP server: off this machine whoever has the key, or everybody where that was asked for."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from starlette.responses import JSONResponse

from s2a_bench.transport.credentials import has_key
from s2a_bench.transport.http import own

OPEN = "/health"
"""The one path that needs no key."""
App = Callable[..., Awaitable[None]]


def keyed(app: App, key: str) -> App:
    """Wrap an ASGI application: a request without the key is 401 before its body is read."""
    expected = key.encode()

    async def wrapped(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope["path"] == OPEN or allowed(scope["headers"], expected):
            await app(scope, receive, send)
            return
        message = "this server wants its key: Authorization: Bearer KEY"
        await JSONResponse(own.error_json(401, message), 401, {"WWW-Authenticate": "Bearer"})(scope, receive, send)

    return wrapped if key else app


def allowed(headers: list[tuple[bytes, bytes]], expected: bytes) -> bool:
    """Whether the one Authorization header has the key."""
    said = [value for name, value in headers if name == b"authorization"]
    return len(said) == 1 and has_key(said[0], "Bearer", expected)
