"""Which flavour of OpenAI's dialect a server speaks, asked once, before anything is measured."""

from __future__ import annotations

import json

import httpx

from s2a_bench.clock import now_ns
from s2a_bench.transport.http.dialects import OWN
from s2a_bench.transport.http.dialects.common import endpoint

OWNERS = {"llamacpp": "llama-server", "vllm": "vllm", "s2a-bench": OWN}
"""``owned_by`` of the first model -> dialect. Ollama says ``library``, clouds their names: plain OpenAI."""

PATIENCE_S = 5.0
LIMIT = 1 << 20


def detected(base: str, client: httpx.Client, headers: dict[str, str]) -> str:
    """Ask for the list of models; whatever goes wrong means a plain server, and the first request will tell."""
    url = endpoint(base.removesuffix("/chat/completions"), "/v1", "/models")
    try:
        with client.stream("GET", url, headers=headers, timeout=PATIENCE_S) as response:
            owner = json.loads(body_of(response, LIMIT, PATIENCE_S))["data"][0]["owned_by"]
        return OWNERS.get(owner, "openai")
    except (httpx.HTTPError, httpx.InvalidURL, ValueError, KeyError, IndexError, TypeError, RecursionError):
        return "openai"


def body_of(response: httpx.Response, limit: int, patience_s: float) -> str:
    """Return a body's first ``limit`` bytes, or what came of it in time, as text."""
    pieces, size, deadline = [], 0, now_ns() + int(patience_s * 1e9)
    for piece in response.iter_bytes():
        pieces.append(piece)
        size += len(piece)
        if size >= limit or now_ns() > deadline:
            break
    return b"".join(pieces)[:limit].decode("utf-8", "replace")
