"""Security risks of an external HTTP server, and when it closes idle connections, as its list of models shows them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from re import findall
from urllib.parse import SplitResult, urlunsplit

import httpx

from s2a_bench.errors import S2AError, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.http.detect import getter, probe
from s2a_bench.transport.http.dialects.common import NO_LIST, endpoint, first_model
from s2a_bench.transport.risks import idle_cut, no_key, printable


def examine(address: SplitResult) -> Iterator[Finding]:
    """Request the list of models without a key, and where there is none an action of no observation."""
    url = urlunsplit(address)
    idle: set[str] = set()
    try:
        with probe(url) as client:
            client.event_hooks["response"] = [
                lambda reply: idle.update(findall(r"timeout=(\d{1,6})", reply.headers.get("keep-alive", "")))
            ]
            owner, model = first_model(url, getter(client, {}))
    except ServerDied as error:
        raise OSError(str(error).rpartition(": ")[2]) from error
    except (*NO_LIST, S2AError, httpx.HTTPError, httpx.InvalidURL) as error:
        yield Finding("server", "state", f"it answers, and shows no list of models without a key: {error}")
        return
    for seconds in sorted(idle)[:1]:
        yield idle_cut(int(seconds), "send requests more often, or start the server with a longer keep-alive")
    if model or _acts(endpoint(url, "", "/act")):
        shown = f"shows its models to every client ({printable(model)}{owner and f' of {printable(owner)}'})"
        yield no_key(
            address,
            f"it {shown if model else 'answers an empty request to /act'}, so it answers every client too",
            "start it with a key, as llama-server --api-key, and name its variable with --api-key-env, or put a proxy "
            "with a key before it",
        )
    else:
        yield Finding("server", "state", "it answers, and shows no list of models without a key")


def _acts(url: str) -> bool:
    """Return whether a server takes POST alone, and from everybody an object whose refusal needs no model."""
    with suppress(S2AError, httpx.HTTPError), probe(url) as client:
        if client.get(url).status_code == httpx.codes.METHOD_NOT_ALLOWED:
            return client.post(url, json={}).status_code in {200, 400, 500}
    return False
