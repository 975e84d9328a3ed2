"""Text Generation Inference's ``/generate_stream``: one event a token with its id, no ``[DONE]``."""

from __future__ import annotations

from typing import Any

from s2a_bench.facts import PREDICTED_N, PROMPT_N
from s2a_bench.transport.http.dialects import Event, Picture
from s2a_bench.transport.http.dialects.common import (
    TEMPERATURE,
    TOP_P,
    Chat,
    Get,
    endpoint,
    numbers,
    refuse_grammar,
    text_of,
    token_id,
)
from s2a_bench.types import Request

DETAILS = {"generated_tokens": PREDICTED_N, "input_length": PROMPT_N}


class Tgi(Chat):
    """The native route; the chat route is the dialect `openai`."""

    name = "tgi"
    tells = tuple(DETAILS.values())

    def met(self, base: str, model: str, get: Get) -> tuple[str, str]:  # noqa: ARG002 - a server has one model
        """Ask for nothing."""
        return base, model

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - a server has one model
        """Return the streaming route."""
        return endpoint(base, "", "/generate_stream")

    def body(self, request: Request, pictures: list[Picture], model: str) -> dict[str, Any]:  # noqa: ARG002
        """Return the prompt with its pictures in Markdown, and ask for details."""
        refuse_grammar(request, self.name)
        marked = [f"![](data:{picture.media_type};base64,{picture.base64})" for picture in pictures]
        parameters = {
            "max_new_tokens": request.max_tokens,
            "temperature": TEMPERATURE,
            "top_p": TOP_P,
            "seed": request.seed,
            "details": True,
        }
        return {"inputs": "".join([*marked, request.prompt]), "parameters": parameters}

    def event(self, message: Any) -> Event:
        """Read one token; the last event carries the whole text as well, and special tokens are no text."""
        token = message.get("token") or {}
        details = message.get("details") or {}
        finish = ""
        if message.get("generated_text") is not None:
            finish = text_of(details.get("finish_reason") or "stop")
        text = "" if token.get("special") else text_of(token.get("text") or "")
        return Event(text or None, token_id(token.get("id")), "", finish, numbers(details, DETAILS))
