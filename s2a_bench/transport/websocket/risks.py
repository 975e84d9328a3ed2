"""What a foreign policy server over WebSocket does that is dangerous, from its greeting; no request is sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from urllib.parse import SplitResult, urlunsplit

from s2a_bench import extras
from s2a_bench.errors import S2AError, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.risks import PATIENCE_S, no_key, printable
from s2a_bench.transport.websocket import PACKAGES

PAGE = "https://example.org"


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Shake hands without a key, and once more as a web page in a browser does."""
    extras.need("websocket", *PACKAGES)
    url = urlunsplit(parts)
    try:
        greeting = _greeting(url, {})
    except ServerDied as error:
        raise OSError(str(error).rpartition(": ")[2]) from error
    except S2AError as error:
        yield Finding("server", "state", f"it answers, and greets no client without a key: {error}")
        return
    yield no_key(
        parts,
        f"it greets every client ({greeting}), so it answers every client too",
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


def _greeting(url: str, headers: Mapping[str, str]) -> str:
    """Return what a server says of itself, in a few words."""
    from s2a_bench.transport.websocket.codec import unpackb
    from s2a_bench.transport.websocket.link import BoundedConnection

    with closing(BoundedConnection(url, headers, Bounds(url, PATIENCE_S, 0), PATIENCE_S)) as link:
        message = link.receive()
    if isinstance(message, str):
        return printable(message)
    metadata = unpackb(message)
    return (
        printable(", ".join(map(str, metadata)) if isinstance(metadata, dict) else type(metadata).__name__) or "nothing"
    )
