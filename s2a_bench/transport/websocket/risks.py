"""What a policy server over WebSocket does that is dangerous or slow, from its handshake; no request is sent."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import closing
from urllib.parse import SplitResult, urlunsplit

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.observation import names, template_of
from s2a_bench.transport.risks import PATIENCE_S, idle_cut, no_key, printable
from s2a_bench.transport.websocket import PACKAGES

PAGE = "https://example.org"
PINGING = "websockets/", "uvicorn"
"""Names, in the header Server, of servers whose handler may block the loop that answers pings."""


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Shake hands without a key, at templates' paths if that is refused, and once more as a page in a browser does."""
    extras.need("websocket", *PACKAGES)
    from s2a_bench.transport.websocket.link import REFUSED

    given, why, headers = parts.path or "/", "", None
    for path in (given, *sorted({template_of(name).server.path or "/" for name in names()} - {given})):
        url = urlunsplit(parts._replace(path=path))
        try:
            greeting, headers = _greeting(url, {})
            break
        except ServerDied as error:
            raise OSError(str(error).rpartition(": ")[2]) from error
        except S2AError as error:
            why = str(error) if REFUSED not in str(error) else why or str(error)
            if REFUSED not in why:
                break
    if headers is None:
        yield Finding("server", "state", f"it answers, and refuses a client without a key: {why}")
        return
    if why:
        yield Finding("path", "advice", f"{why}; it lets clients in at {path}", f"name {url}")
    yield from _slow(parts._replace(path=path), headers)
    yield no_key(
        parts,
        f"it lets every client in (and greets with: {greeting}), so it answers every client too",
        "let it listen on 127.0.0.1 alone and reach it by ssh -L, or put a proxy that wants a key before it",
    )
    try:
        _greeting(url, {"Origin": PAGE})
    except S2AError:
        return
    yield Finding(
        "any-page",
        "warning",
        "it does not look where a handshake comes from: a page of any site in a browser that reaches it may ask it",
        "let it refuse handshakes with an Origin header; robots' clients send none",
    )


def _slow(parts: SplitResult, headers: Mapping[str, str]) -> Iterator[Finding]:
    if "permessage-deflate" in headers.get("Sec-WebSocket-Extensions", ""):
        yield Finding(
            "compression",
            "advice",
            "it compresses with clients that offer it, as libraries do by default: deflating two 224x224 pictures of "
            f"noise takes {_deflate_ms():.1f} ms here, for each observation",
            "connect with compression=None, as the clients of openpi and s2a-bench do, or turn it off in the server",
        )
    if any(name in headers.get("Server", "") for name in PINGING):
        yield Finding(
            "keepalive",
            "advice",
            "a policy that blocks its event loop, as openpi's does, leaves pings unanswered: a client that waits 20 s "
            "for each, the libraries' default, disconnects, and an answer that takes longer is lost",
            "connect with ping_interval=None; s2a-bench sends no pings",
        )
    servers = {name: template_of(name).server for name in names()}
    cut = {name: each.idle_s for name, each in servers.items() if each.idle_s and each.path == parts.path.rstrip("/")}
    if cut:
        cure = f"--template {' or '.join(cut)}, of servers with this path: it keeps the connection open"
        yield idle_cut(min(cut.values()), cure)


def _deflate_ms() -> float:
    noise, deflate = os.urandom(2 * 224 * 224 * 3), zlib.compressobj(wbits=-12, memLevel=5)
    started_ns = now_ns()
    deflate.compress(noise)
    return (now_ns() - started_ns) / 1e6


def _greeting(url: str, headers: Mapping[str, str]) -> tuple[str, Mapping[str, str]]:
    """Return what a server says of itself, in a few words, and the headers of its handshake."""
    from websockets.extensions.permessage_deflate import ClientPerMessageDeflateFactory

    from s2a_bench.transport.websocket.codec import unpackb
    from s2a_bench.transport.websocket.link import BoundedConnection

    bounds, offered = Bounds(url, PATIENCE_S, 0), [ClientPerMessageDeflateFactory()]
    with closing(BoundedConnection(url, headers, bounds, PATIENCE_S, extensions=offered)) as link:
        try:
            message = link.receive()
        except RequestFailed:  # as of servers that wait for their client's first message
            message = ""
    if not isinstance(message, str):
        metadata = unpackb(message)
        message = ", ".join(map(str, metadata)) if isinstance(metadata, dict) else type(metadata).__name__
    return printable(message) or "nothing", link.headers()
