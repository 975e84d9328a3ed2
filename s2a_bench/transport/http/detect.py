"""Questions to a server outside the measurement: its dialect, its models, the hits of its caches, what distorts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any
from urllib.parse import SplitResult, urlsplit, urlunsplit

import httpx

from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.trace import FACT_LIMIT
from s2a_bench.transport import Wiring
from s2a_bench.transport.http.clients import pieces, usual_client
from s2a_bench.transport.http.dialects import NATIVE, open_dialect
from s2a_bench.transport.http.dialects.common import NO_LIST, NO_MODEL, Dialect, endpoint, first_model
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import read_key
from s2a_bench.transport.risks import PATIENCE_S, idle_cut

OWNERS = {"llamacpp": "llama-server", "vllm": "vllm", "s2a-bench": NATIVE}
"""``owned_by`` of the first model -> dialect. Ollama gives ``library``, clouds their names: plain OpenAI."""

HITS = re.compile(r"^(\w+:\w*(?:hits|cached_tokens|tokens_cached)(?:_total)?)(?:\{.*\})? (\S+)", re.MULTILINE)
"""A counter of cache hits: vLLM's of prefixes and pictures, SGLang's of prompt tokens."""


def met(base: str, key: str, options: HttpOptions) -> tuple[Dialect, str, str]:
    """Return the dialect, the URL to post to and the model of a black box: as given, else as its list of models says.

    A server with an invalid list counts as plain OpenAI. Raises ServerDied if nothing answers.
    """
    spoken, model = options.spoken, options.served_model
    with probe(base) as client:
        if not spoken:
            headers = open_dialect("openai").authorization(key) if key else {}
            owner, first = first_model(base, partial(_json, client, headers))
            spoken, model = OWNERS.get(owner, "openai"), model or first or NO_MODEL
        dialect = open_dialect(spoken, options)
        headers = dialect.authorization(key) if key else {}
        base, model = dialect.met(base, model, partial(_json, client, headers))
    return dialect, dialect.url(base, model), model


def probe(url: str) -> httpx.Client:
    """Return a client for requests that are not measured."""
    return usual_client(url, PATIENCE_S)


def cache_hits(wiring: Wiring[HttpOptions]) -> Mapping[str, float]:
    """Return the counters of cache hits among a server's Prometheus metrics, empty without such metrics."""
    hits: dict[str, float] = {}
    try:
        url = urlsplit(wiring.address)
        path = re.sub(r"/(v1|v1beta|api)(/.*)?$", "", url.path.rstrip("/")) + "/metrics"
        with probe(wiring.address) as client:
            key = read_key(wiring.options.api_key_env)
            headers = {"authorization": f"Bearer {key}"} if key else {}
            text = _text(client, headers, urlunsplit((url.scheme, url.netloc, path, "", "")))
        for name, value in HITS.findall(text):
            if 0 <= float(value) <= FACT_LIMIT:
                hits[name] = hits.get(name, 0.0) + float(value)
    except (*NO_LIST, ServerDied, RequestFailed, httpx.HTTPError, httpx.InvalidURL):
        return {}
    return hits


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Request the list of models without a key: its headers show how the server treats its connections."""
    url = endpoint(urlunsplit(parts).removesuffix("/chat/completions"), "/v1", "/models")
    try:
        with probe(url) as client, client.stream("GET", url) as response:
            closes = response.http_version == "HTTP/1.0" or response.headers.get("connection") == "close"
            idle = re.search(r"timeout=(\d{1,6})", response.headers.get("keep-alive", ""))
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise OSError(str(error)) from error
    if idle:
        yield idle_cut(int(idle[1]), "send requests more often, or start the server with a longer keep-alive")
    if closes and response.is_success:
        what = "it closes the connection after each answer: each request connects first"
        yield Finding("connections", "advice", what, "let the server, or a proxy before it, keep connections")


def _json(client: httpx.Client, headers: dict[str, str], url: str) -> Any:
    try:
        return json.loads(_text(client, headers, url))
    except (RequestFailed, httpx.HTTPError, httpx.InvalidURL) as error:
        raise ValueError(str(error)) from error


def _text(client: httpx.Client, headers: dict[str, str], url: str) -> str:
    """Return the body of a GET; raises ServerDied if nothing answers, RequestFailed if the answer does not end."""
    try:
        with client.stream("GET", url, headers=headers) as response:
            response.raise_for_status()
            return text_of(pieces(response, Bounds(url, PATIENCE_S, 0)))
    except httpx.ConnectError as error:
        raise ServerDied(f"nothing answers at {url}: {error}") from error


def text_of(body: Iterable[bytes]) -> str:
    return b"".join(body).decode("utf-8", "replace")
