"""The base of dialects, and their shared functions: joining URLs, reading numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import nan
from typing import Any, TypeAlias
from urllib.parse import urlsplit, urlunsplit

from s2a_bench.errors import UsageError
from s2a_bench.facts import CACHE_N, PROMPT_N, USAGE_ZERO, Fact
from s2a_bench.trace import FACT_LIMIT, Trace
from s2a_bench.transport import TOKENS, TransportOptions
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.framing import Framing, ServerSentEvents
from s2a_bench.types import Pixels, Request

TEMPERATURE, TOP_P = 0.7, 0.8

Get: TypeAlias = Callable[[str], Any]
"""Returns the JSON at a URL; raises ValueError if there is none, ServerDied if nothing answers."""

NO_MODEL = "default"
"""The requested model if a server lists none."""

NO_LIST = (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError)
"""Exceptions of reading a missing or malformed list."""

VOCABULARY = 1 << 31


class Dialect:
    """One dialect, stateless and without I/O: by default a chat that streams server-sent events."""

    name: str
    root, path = "", ""
    """The path below a server's URL: the root of the API, and the rest."""
    lists_models = True
    takes_grammar = False
    media_type = "text/event-stream"
    """The beginning of a good answer's content-type."""
    payloads: tuple[str, ...] = ("jpeg", "jpeg-preencoded", "png")
    framing: Callable[[], Framing] = ServerSentEvents
    facts: Sequence[Fact] = ()
    answer_kinds: tuple[str, ...] = (TOKENS,)
    accepts_state = False
    takes_task = False
    options: type[TransportOptions] | None = None
    """Options that the transport gets from it, which only this dialect reads."""
    packages: Sequence[str] = ()
    """Python packages whose versions are recorded with results."""

    def configure(self, options: Any) -> None:
        """Read the transport's options, with its own; raises UsageError, MissingExtra."""

    def check(self, cameras: int, state: int) -> None:
        """Raise UsageError if a request cannot have so many pictures, or numbers of the state."""

    def met(self, base: str, model: str, get: Get) -> tuple[str, str]:
        """Return the URL and the model of requests: as given, else the first model that the server lists."""
        if not self.lists_models:
            return base, model
        return base, model or first_model(base, get)[1] or NO_MODEL

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - some have the model in the path
        return endpoint(base, self.root, self.path)

    def authorization(self, key: str) -> dict[str, str]:
        """Return the headers that carry an API key (RFC 6750)."""
        return {"authorization": f"Bearer {key}"}

    def fields(
        self, request: Request, payload: str, model: str, to_base64: Callable[[Pixels], str], trace: Trace
    ) -> dict[str, Any]:
        from s2a_bench.transport.pictures import encoded

        pictures = []
        for frame in request.images:
            media_type, data = encoded(frame, payload, trace)
            pictures.append(EncodedPicture(media_type, to_base64(data.reshape(-1))))
            trace.mark("base64_encode")
        return self.body(request, pictures, model)

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:
        """Return the request's body; raises UsageError for what the dialect cannot express."""
        raise NotImplementedError

    def event(self, message: Any) -> Event:
        """Read one message; the Decoder catches the exceptions for a malformed one."""
        raise NotImplementedError

    def starts_with_headers(self, facts: dict[str, float]) -> bool:  # noqa: ARG002 - for llama-server
        """Return True if the server is known to send the response's headers when inference starts."""
        return False


def endpoint(base: str, root: str, path: str, query: str = "") -> str:
    """Join a user's URL with a dialect's path; the URL may end with the server, the API's root, or the path."""
    try:
        url = urlsplit(base)
    except ValueError as error:
        raise UsageError(f"`url`: '{base}' is not a URL: {error}") from error
    whole = url.path.rstrip("/")
    if not whole.endswith(path):
        whole = whole.removesuffix(root) + root + path
    return urlunsplit((url.scheme, url.netloc, whole, "&".join(filter(None, (url.query, query))), ""))


def first_model(base: str, get: Get) -> tuple[str, str]:
    """Return the owner and the name of the first model on OpenAI's list; empty without such a list."""
    try:
        first = get(endpoint(base.removesuffix("/chat/completions"), "/v1", "/models"))["data"][0]
        return text_of(first.get("owned_by") or ""), text_of(first["id"])
    except NO_LIST:
        return "", ""


def sampled(request: Request, max_tokens: str = "max_tokens", top_p: str = "top_p") -> dict[str, Any]:
    return {max_tokens: request.max_tokens, "temperature": TEMPERATURE, top_p: TOP_P, "seed": request.seed}


def numbers(source: Any, names: dict[str, Fact], scale: float = 1.0) -> dict[str, float]:
    """Return the numbers of a JSON object as facts, times ``scale``; missing and null values are left out.

    NaN stands for anything but a number of 0 to 2^53: `Trace.learn` reports it.
    """
    values = ((fact, (source or {}).get(name)) for name, fact in names.items())
    return {fact: _number(value) * scale for fact, value in values if value is not None}


def _number(value: Any) -> float:
    return float(value) if type(value) in {int, float} and 0 <= value <= FACT_LIMIT else nan


def evaluated(facts: dict[str, float]) -> dict[str, float]:
    """Count the prompt like llama.cpp: the evaluated tokens, without those from the cache."""
    if PROMPT_N not in facts:
        return facts
    return {**facts, PROMPT_N: _number(facts[PROMPT_N] - facts.get(CACHE_N, 0.0))}


def token_id(value: Any) -> int:
    """Return a token's index in a vocabulary, or -1 for an invalid one."""
    return value if type(value) is int and 0 <= value < VOCABULARY else -1


def usage_of(source: Any, names: dict[str, Fact]) -> dict[str, float]:
    """Return the counts of a usage object as facts; one of zeros alone becomes `USAGE_ZERO`."""
    counts = numbers(source, names)
    return {USAGE_ZERO: 1.0} if counts and not any(counts.values()) else counts


def text_of(value: Any) -> str:
    """Return a text unchanged; raises TypeError for anything else."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} where text should be")
    return value
