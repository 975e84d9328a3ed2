"""The dialect `toy-chat`: Ollama's form on another route."""

from __future__ import annotations

from s2a_bench.transport.http.dialects.common import endpoint
from s2a_bench.transport.http.dialects.ollama import Ollama


class ToyChat(Ollama):
    """POST /toy/chat, lines of JSON."""

    name = "toy-chat"

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - the model is in the body
        """Return the route."""
        return endpoint(base, "/toy", "/chat")
