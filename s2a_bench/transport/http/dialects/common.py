"""What a dialect is, and what dialects share: joining URLs, reading numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import nan
from typing import Any, TypeAlias
from urllib.parse import urlsplit, urlunsplit

from s2a_bench.errors import UsageError
from s2a_bench.facts import CACHE_N, PROMPT_N, USAGE_ZERO, Fact
from s2a_bench.trace import FACT_LIMIT, Trace
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.framing import Framing, ServerSentEvents
from s2a_bench.transport.pictures import encoded
from s2a_bench.types import Frame, Pixels, Request

TEMPERATURE, TOP_P = 0.7, 0.8
"""As our own llama engine samples."""

Get: TypeAlias = Callable[[str], Any]
"""Return the JSON at a URL; raises ValueError where there is none, ServerDied where nothing answers."""

NO_MODEL = "default"
"""What a server is asked for that names no model of its own."""

NO_LIST = (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError)
"""What reading a list of another form, or none, raises."""

VOCABULARY = 1 << 31
"""Larger than any."""


class Dialect:
    """One dialect, pure and without state: a chat that streams server-sent events, unless a subclass says otherwise."""

    name: str
    root, path = "", ""
    """Where it is asked, below a server's URL: the root of the API, and the rest."""
    lists_models = True
    """Whether a model is chosen among those that the server lists."""
    takes_grammar = False
    """Whether it has a field for a GBNF grammar."""
    media_type = "text/event-stream"
    """What a good answer's content-type starts with."""
    payloads: tuple[str, ...] = ("jpeg", "jpeg-preencoded", "png")
    """How pictures can travel."""
    framing: Callable[[], Framing] = ServerSentEvents
    facts: Sequence[Fact] = ()
    """The facts of its events."""

    def met(self, base: str, model: str, get: Get) -> tuple[str, str]:
        """Return the URL and the model to ask: as told, else the first that the server lists."""
        if not self.lists_models:
            return base, model
        return base, model or first_model(base, get)[1] or NO_MODEL

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - some have the model in the path
        """Return where to post, for the URL that a user gave."""
        return endpoint(base, self.root, self.path)

    def authorization(self, key: str) -> dict[str, str]:
        """Return the headers that carry an API key (RFC 6750)."""
        return {"authorization": f"Bearer {key}"}

    def encode(self, frame: Frame, payload: str, trace: Trace) -> tuple[str, Pixels]:
        """Return the media type and the bytes of a picture, marking each stage."""
        return encoded(frame, payload, trace)

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:
        """Return the request's body; raises UsageError for what the dialect cannot say."""
        raise NotImplementedError

    def event(self, message: Any) -> Event:
        """Return what one message means; whatever it raises for a message of another form is the Decoder's to catch."""
        raise NotImplementedError

    def starts_with_headers(self, facts: dict[str, float]) -> bool:  # noqa: ARG002 - llama-server's tell
        """Return whether the response's headers are known to have left when inference started."""
        return False


def endpoint(base: str, root: str, path: str, query: str = "") -> str:
    """Join a user's URL with a dialect's path: it may end with the server, with the API's root, or be whole."""
    try:
        parts = urlsplit(base)
    except ValueError as error:
        raise UsageError(f"`url`: '{base}' is no URL: {error}") from error
    here = parts.path.rstrip("/")
    if not here.endswith(path):
        here = here.removesuffix(root) + root + path
    return urlunsplit((parts.scheme, parts.netloc, here, "&".join(filter(None, (parts.query, query))), ""))


def first_model(base: str, get: Get) -> tuple[str, str]:
    """Return by whom the first model on OpenAI's list is owned, and its name; empty where there is no such list."""
    try:
        first = get(endpoint(base.removesuffix("/chat/completions"), "/v1", "/models"))["data"][0]
        return text_of(first.get("owned_by") or ""), text_of(first["id"])
    except NO_LIST:
        return "", ""


def sampled(request: Request, max_tokens: str = "max_tokens", top_p: str = "top_p") -> dict[str, Any]:
    """Return how an answer is sampled, under a dialect's names."""
    return {max_tokens: request.max_tokens, "temperature": TEMPERATURE, top_p: TOP_P, "seed": request.seed}


def numbers(source: Any, names: dict[str, Fact], scale: float = 1.0) -> dict[str, float]:
    """Return the numbers of a JSON object as facts, times ``scale``; what is missing or null stays absent.

    NaN stands for anything but a number of 0 to 2^53: `Trace.learn` tells of it.
    """
    found = source or {}
    told = ((ours, found.get(theirs)) for theirs, ours in names.items())
    return {ours: _number(value) * scale for ours, value in told if value is not None}


def _number(value: Any) -> float:
    return float(value) if type(value) in {int, float} and 0 <= value <= FACT_LIMIT else nan


def evaluated(facts: dict[str, float]) -> dict[str, float]:
    """Count the prompt as llama.cpp does: the tokens that were evaluated, without those from the cache."""
    if PROMPT_N not in facts:
        return facts
    return {**facts, PROMPT_N: _number(facts[PROMPT_N] - facts.get(CACHE_N, 0.0))}


def token_id(value: Any) -> int:
    """Return a token's place in a vocabulary, or -1 for what can be none."""
    return value if type(value) is int and 0 <= value < VOCABULARY else -1


def usage_of(source: Any, names: dict[str, Fact]) -> dict[str, float]:
    """Return the counts of a usage object as facts; one of zeros alone tells nothing, which is noted."""
    counts = numbers(source, names)
    return {USAGE_ZERO: 1.0} if counts and not any(counts.values()) else counts


def text_of(value: Any) -> str:
    """Return a text as it is; raises TypeError for anything else, which would fail far from here."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} where text should be")
    return value
