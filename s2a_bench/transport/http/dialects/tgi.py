"""Text Generation Inference's ``/generate_stream``: one event a token with its id, no ``[DONE]``."""

from __future__ import annotations

from typing import Any

from s2a_bench.facts import PREDICTED_N, PROMPT_N
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.common import Dialect, numbers, sampled, text_of, token_id
from s2a_bench.types import Request

DETAILS = {"generated_tokens": PREDICTED_N, "input_length": PROMPT_N}


class Tgi(Dialect):
    """The native route; the chat route is the dialect `openai`."""

    name = "tgi"
    path = "/generate_stream"
    lists_models = False
    facts = tuple(DETAILS.values())

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:  # noqa: ARG002
        marked = [f"![](data:{picture.media_type};base64,{picture.base64})" for picture in pictures]
        parameters = {**sampled(request, "max_new_tokens"), "details": True}
        return {"inputs": "".join([*marked, request.prompt]), "parameters": parameters}

    def event(self, message: Any) -> Event:
        """Read one token; the last event has the whole text too, and special tokens have no text."""
        token = message.get("token") or {}
        details = message.get("details") or {}
        finish = ""
        if message.get("generated_text") is not None:
            finish = text_of(details.get("finish_reason") or "stop")
        text = "" if token.get("special") else text_of(token.get("text") or "")
        return Event(text or None, token_id(token.get("id")), "", finish, numbers(details, DETAILS))
