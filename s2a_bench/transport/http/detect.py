"""What a server says of itself when nothing is measured: its dialect, its models, the hits of its caches."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import httpx

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.trace import FACT_LIMIT
from s2a_bench.transport.bounds import Bounds
from s2a_bench.transport.http.bounded import BoundedClient
from s2a_bench.transport.http.dialects import OWN
from s2a_bench.transport.http.dialects.common import NO_LIST, Get, first_model
from s2a_bench.transport.http.lean import LeanResponse

OWNERS = {"llamacpp": "llama-server", "vllm": "vllm", "s2a-bench": OWN}
"""``owned_by`` of the first model -> dialect. Ollama says ``library``, clouds their names: plain OpenAI."""

HITS = re.compile(r"^(\w+:\w*(?:hits|cached_tokens|tokens_cached)(?:_total)?)(?:\{.*\})? (\S+)", re.MULTILINE)
"""A counter of cache hits: vLLM's of prefixes and pictures, SGLang's of prompt tokens."""

PATIENCE_S = 5.0
LIMIT = 1 << 20


def detected(base: str, get: Get) -> tuple[str, str]:
    """Return a server's dialect and its first model, by its list of models; what makes no sense means a plain one.

    Raises ServerDied where nothing answers.
    """
    owner, model = first_model(base, get)
    return OWNERS.get(owner, "openai"), model


def cache_hits(base: str, key: str = "") -> Mapping[str, float]:
    """Return the counters of cache hits among a server's Prometheus metrics; nothing where it tells none."""
    found: dict[str, float] = {}
    try:
        parts = urlsplit(base)
        path = re.sub(r"/(v1|v1beta|api)(/.*)?$", "", parts.path.rstrip("/")) + "/metrics"
        with BoundedClient(Bounds(base, PATIENCE_S, 0), trust_env=parts.scheme == "https") as client:
            headers = {"authorization": f"Bearer {key}"} if key else {}
            text = _text(urlunsplit((parts.scheme, parts.netloc, path, "", "")), client, headers)
        for name, value in HITS.findall(text):
            if 0 <= float(value) <= FACT_LIMIT:
                found[name] = found.get(name, 0.0) + float(value)
    except (*NO_LIST, ServerDied, RequestFailed, httpx.HTTPError, httpx.InvalidURL):
        return {}
    return found


def getter(client: BoundedClient, headers: dict[str, str]) -> Get:
    """Return what asks for JSON at a URL, bounded in size and time."""

    def get(url: str) -> Any:
        try:
            return json.loads(_text(url, client, headers))
        except (RequestFailed, httpx.HTTPError, httpx.InvalidURL) as error:
            raise ValueError(str(error)) from error

    return get


def _text(url: str, client: BoundedClient, headers: dict[str, str]) -> str:
    """Return what a GET answers; raises ServerDied where nothing does, RequestFailed where it does not end."""
    client.bounds = Bounds(url, PATIENCE_S, 0)
    try:
        with client.stream("GET", url, headers=headers, timeout=PATIENCE_S) as response:
            response.raise_for_status()
            return body_of(response, LIMIT, PATIENCE_S)
    except httpx.ConnectError as error:
        raise ServerDied(f"nothing answers at {url}: {error}") from error


def body_of(response: httpx.Response | LeanResponse, limit: int, patience_s: float) -> str:
    """Return a body's first ``limit`` bytes, or what came of it in time, as text."""
    pieces, size, deadline = [], 0, now_ns() + int(patience_s * 1e9)
    for piece in response.iter_raw():
        pieces.append(piece)
        size += len(piece)
        if size >= limit or now_ns() > deadline:
            break
    return b"".join(pieces)[:limit].decode("utf-8", "replace")
