"""Questions to a server outside the measurement: its dialect, its models, the hits of its caches, what distorts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Any
from urllib.parse import SplitResult, urlsplit, urlunsplit

import httpx

from s2a_bench.errors import RequestFailed, S2AError, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.trace import FACT_LIMIT
from s2a_bench.transport import Wiring
from s2a_bench.transport.http.clients import pieces, usual_client
from s2a_bench.transport.http.dialects import DIALECTS, NATIVE, open_dialect
from s2a_bench.transport.http.dialects.common import NO_LIST, NO_MODEL, Dialect, endpoint, first_model
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import read_key
from s2a_bench.transport.risks import NO_KEY, PATIENCE_S, idle_cut

OWNERS = {"llamacpp": "llama-server", "vllm": "vllm", "s2a-bench": NATIVE}
"""``owned_by`` of the first model -> dialect. Ollama gives ``library``, clouds their names: plain OpenAI."""

HITS = re.compile(r"^(\w+:\w*(?:hits|cached_tokens|tokens_cached)(?:_total)?)(?:\{.*\})? (\S+)", re.MULTILINE)
"""A counter of cache hits: vLLM's of prefixes and pictures, SGLang's of prompt tokens."""

LIMIT = 1 << 20


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


def examine(parts: SplitResult) -> Iterator[Finding | str]:
    """Request the list of models without a key, and where there is none an action of no observation."""
    url, model, why = urlunsplit(parts), "", ""
    heads: list[httpx.Response] = []
    try:
        with probe(url) as client:
            client.event_hooks["response"] = [heads.append]
            _, model = first_model(url, partial(_json, client, {}))
    except ServerDied as error:
        raise OSError(str(error).rpartition(": ")[2]) from error
    except (*NO_LIST, S2AError, httpx.HTTPError, httpx.InvalidURL) as error:
        why = f": {error}"
    for head in heads[-1:]:
        if idle := re.search(r"timeout=(\d{1,6})", head.headers.get("keep-alive", "")):
            yield idle_cut(int(idle[1]), "send requests more often, or start the server with a longer keep-alive")
        if head.is_success and (head.http_version == "HTTP/1.0" or head.headers.get("connection") == "close"):
            what = "it closes the connection after each answer: each request connects first"
            yield Finding("connections", "advice", what, "let the server, or a proxy before it, keep connections")
    if model or (not why and _acts(url)):
        yield NO_KEY
    else:
        yield Finding("server", "state", f"it answers, and shows no list of models without a key{why}")


def _acts(base: str) -> bool:
    """Return whether a policy takes POST alone, and from everybody an object whose refusal needs no model."""
    for url in (endpoint(base, "", each.path) for _, each in DIALECTS.loaded() if each.takes_task):
        with suppress(S2AError, httpx.HTTPError), probe(url) as client:
            if _status(client, "GET", url) == httpx.codes.METHOD_NOT_ALLOWED:
                return _status(client, "POST", url, json={}) in {200, 400, 500}
    return False


def _status(client: httpx.Client, method: str, url: str, **options: Any) -> int:
    """Return the status of an answer whose body is not read."""
    with client.stream(method, url, **options) as response:
        return response.status_code


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
            return text_of(pieces(response, Bounds(url, PATIENCE_S, 0)), LIMIT)
    except httpx.ConnectError as error:
        raise ServerDied(f"nothing answers at {url}: {error}") from error


def text_of(body: Iterable[bytes], limit: int) -> str:
    """Return a body's first ``limit`` bytes as text."""
    data = bytearray()
    for piece in body:
        data += piece
        if len(data) >= limit:
            break
    return data[:limit].decode("utf-8", "replace")
