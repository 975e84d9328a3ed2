"""Ollama's ``/api/chat``: lines of JSON, pictures as bare Base64, timings in nanoseconds on the last line."""

from __future__ import annotations

from typing import Any

from s2a_bench.transport.http.dialects import Event, Picture
from s2a_bench.transport.http.dialects.common import (
    TEMPERATURE,
    TOP_P,
    Chat,
    endpoint,
    numbers,
    refuse_grammar,
    text_of,
)
from s2a_bench.transport.http.dialects.framing import JsonLines
from s2a_bench.types import Request

COUNTS = {"prompt_eval_count": "prompt_with_cached_n", "eval_count": "predicted_n"}
"""Its count of the prompt holds the tokens that came from its cache, so it is not that of tokens evaluated."""
DURATIONS = {
    "total_duration": "total_ms",
    "load_duration": "load_ms",
    "prompt_eval_duration": "prompt_ms",
    "eval_duration": "predicted_ms",
}
"""``api/types.go``; all in ns, and left out where zero."""


class Ollama(Chat):
    """The native chat route, which alone tells timings."""

    name = "ollama"
    media_type = "application/x-ndjson"
    framing = JsonLines

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - other dialects have the model in the path
        """Return the chat route."""
        return endpoint(base, "/api", "/chat")

    def body(self, request: Request, pictures: list[Picture], model: str) -> dict[str, Any]:
        """Return one user message; whether the model thinks is left to the server's default."""
        refuse_grammar(request, self.name)
        message = {"role": "user", "content": request.prompt, "images": [picture.base64 for picture in pictures]}
        options = {
            "num_predict": request.max_tokens,
            "temperature": TEMPERATURE,
            "top_p": TOP_P,
            "seed": request.seed,
        }
        return {"model": model, "stream": True, "options": options, "messages": [message]}

    def event(self, message: Any) -> Event:
        """Read one line."""
        said = message.get("message") or {}
        finish = text_of(message.get("done_reason") or "stop") if message.get("done") else ""
        facts = {**numbers(message, COUNTS), **numbers(message, DURATIONS, 1e-6)}
        if {"total_ms", "prompt_ms", "predicted_ms"} <= facts.keys():
            known = facts["prompt_ms"] + facts["predicted_ms"] + facts.get("load_ms", 0.0)
            facts["outside_model_ms"] = facts["total_ms"] - known
        thinking = text_of(said.get("thinking") or "")
        return Event(text_of(said.get("content") or "") or None, -1, thinking, finish, facts)
