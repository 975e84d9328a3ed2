"""Gemini's ``streamGenerateContent``: server-sent events that end with the body, errors as bare JSON."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from s2a_bench.facts import CACHE_N, PREDICTED_N, PROMPT_N, THINKING_N, USAGE_ZERO
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.common import (
    NO_LIST,
    NO_MODEL,
    Dialect,
    Get,
    endpoint,
    evaluated,
    first_model,
    sampled,
    text_of,
    usage_of,
)
from s2a_bench.types import Request

USAGE = {
    "promptTokenCount": PROMPT_N,
    "candidatesTokenCount": PREDICTED_N,
    "thoughtsTokenCount": THINKING_N,
    "cachedContentTokenCount": CACHE_N,
}
VERSIONS = ("/v1beta", "/v1")
"""Roots of the API, the usual one first."""
COMPLETE = frozenset({"STOP", "MAX_TOKENS"})
"""All other reasons (SAFETY, RECITATION, ...) mean that the answer was cut."""


class Gemini(Dialect):
    name = "gemini"
    facts = (*USAGE.values(), USAGE_ZERO)

    def met(self, base: str, model: str, get: Get) -> tuple[str, str]:
        """Return the URL with the server's version, and the model, by default the first that the server lists."""
        url = base.rstrip("/")
        versions = [version for version in VERSIONS if url.endswith(version)]
        if versions and model:
            return base, model
        for version in versions or VERSIONS:
            root = url.removesuffix(version) + version
            try:
                names = [text_of(one["name"]) for one in get(f"{root}/models")["models"] if _answers(one)]
                return root, model or names[0].removeprefix("models/")
            except NO_LIST:  # it may answer under the other version
                continue
        return base, model or first_model(url.removesuffix("/v1beta"), get)[1] or NO_MODEL  # a gateway's list

    def url(self, base: str, model: str) -> str:
        root = next((version for version in VERSIONS if base.rstrip("/").endswith(version)), VERSIONS[0])
        return endpoint(base, root, f"/models/{quote(model, safe='')}:streamGenerateContent", "alt=sse")

    def authorization(self, key: str) -> dict[str, str]:
        return {"x-goog-api-key": key}

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:  # noqa: ARG002
        """Return one turn of the user; thinking is left to the model's default."""
        inline = [{"inline_data": {"mime_type": picture.media_type, "data": picture.base64}} for picture in pictures]
        return {
            "generationConfig": sampled(request, "maxOutputTokens", "topP"),
            "contents": [{"role": "user", "parts": [*inline, {"text": request.prompt}]}],
        }

    def event(self, message: Any) -> Event:
        text, thinking, finish = "", "", ""
        for candidate in message.get("candidates") or ():
            finish = text_of(candidate.get("finishReason") or "")
            for part in (candidate.get("content") or {}).get("parts") or ():
                if part.get("thought"):
                    thinking += text_of(part.get("text") or "")
                else:
                    text += text_of(part.get("text") or "")
        if blocked := (message.get("promptFeedback") or {}).get("blockReason"):
            return Event(error=f"the prompt was refused: {blocked}")
        if finish and finish not in COMPLETE:
            return Event(error=f"the answer was cut: {finish}")
        facts = evaluated(usage_of(message.get("usageMetadata"), USAGE))
        return Event(text or None, -1, thinking, finish, facts)


def _answers(model: Any) -> bool:
    """Return True if a listed model writes text, or does not state its methods."""
    methods = model.get("supportedGenerationMethods")
    return not methods or "generateContent" in methods
