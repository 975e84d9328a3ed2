"""Ollama's ``/api/chat``: lines of JSON, pictures as bare Base64, timings in nanoseconds on the last line."""

from __future__ import annotations

from typing import Any

from s2a_bench.facts import PREDICTED_MS, PREDICTED_N, PROMPT_MS, Fact
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.common import Dialect, numbers, sampled, text_of
from s2a_bench.transport.http.dialects.framing import JsonLines
from s2a_bench.types import Request

PROMPT_WITH_CACHED_N = Fact("prompt_with_cached_n", "tokens", "prompt, whether evaluated or from its cache")
TOTAL_MS = Fact("total_ms", "ms", "the whole request")
LOAD_MS = Fact("load_ms", "ms", "loading the model")
OUTSIDE_MODEL_MS = Fact("outside_model_ms", "ms", "`total_ms` less `load_ms`, `prompt_ms` and `predicted_ms`")

COUNTS = {"prompt_eval_count": PROMPT_WITH_CACHED_N, "eval_count": PREDICTED_N}
DURATIONS = {
    "total_duration": TOTAL_MS,
    "load_duration": LOAD_MS,
    "prompt_eval_duration": PROMPT_MS,
    "eval_duration": PREDICTED_MS,
}
"""``api/types.go``; all in ns, and left out if zero."""


class Ollama(Dialect):
    """The native chat route, the only one with timings."""

    name = "ollama"
    root, path = "/api", "/chat"
    media_type = "application/x-ndjson"
    framing = JsonLines
    facts = (*COUNTS.values(), *DURATIONS.values(), OUTSIDE_MODEL_MS)

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:
        """Return one user message; thinking is left to the server's default."""
        message = {"role": "user", "content": request.prompt, "images": [picture.base64 for picture in pictures]}
        return {"model": model, "stream": True, "options": sampled(request, "num_predict"), "messages": [message]}

    def event(self, message: Any) -> Event:
        content = message.get("message") or {}
        finish = text_of(message.get("done_reason") or "stop") if message.get("done") else ""
        facts = {**numbers(message, COUNTS), **numbers(message, DURATIONS, 1e-6)}
        if {TOTAL_MS, PROMPT_MS, PREDICTED_MS} <= facts.keys():
            model_ms = facts[PROMPT_MS] + facts[PREDICTED_MS] + facts.get(LOAD_MS, 0.0)
            facts[OUTSIDE_MODEL_MS] = facts[TOTAL_MS] - model_ms
        thinking = text_of(content.get("thinking") or "")
        return Event(text_of(content.get("content") or "") or None, -1, thinking, finish, facts)
