"""Who may ask our HTTP server: off this machine whoever has the key, or everybody where that was asked for."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from ipaddress import ip_address
from typing import Any

from starlette.responses import JSONResponse

from s2a_bench.errors import UsageError
from s2a_bench.transport.credentials import read_key
from s2a_bench.transport.http import own
from s2a_bench.transport.http.options import HttpOptions

OPEN = "/health"
"""The one path that needs no key."""
App = Callable[..., Awaitable[None]]


def key_for(host: str, options: HttpOptions) -> str:
    """Return the key that clients must send, "" for none; raises UsageError where strangers need none by mistake."""
    key = read_key(options.api_key_env)
    if not (key or options.no_auth or ip_address(host).is_loopback):
        raise UsageError(
            f"`host`: others reach {host}; name the environment variable that holds the key that they must send with "
            "`api_key_env`, or let everybody in with `no_auth`"
        )
    return key


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
    """Whether the one Authorization header has the key, compared in constant time (RFC 6750, 2.1)."""
    said = [value for name, value in headers if name == b"authorization"]
    scheme, _, token = said[0].partition(b" ") if len(said) == 1 else (b"", b"", b"")
    return scheme.lower() == b"bearer" and hmac.compare_digest(token.strip(), expected)
