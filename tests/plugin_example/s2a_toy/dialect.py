"""The dialect `toy-chat`: Ollama's form on another route, which an option of its own lengthens."""

from __future__ import annotations

from typing import Any

from s2a_bench.options import option
from s2a_bench.transport import TransportOptions
from s2a_bench.transport.http.dialects.common import endpoint
from s2a_bench.transport.http.dialects.ollama import Ollama


class ToyChatOptions(TransportOptions):
    """Options that HTTP gets with the dialect."""

    toy_channel: str = option("", "the room of the chat, a part of its route")


class ToyChat(Ollama):
    """POST /toy/chat, lines of JSON."""

    name = "toy-chat"
    options = ToyChatOptions
    room = ""

    def configure(self, options: Any) -> None:
        """Read the room."""
        self.room = options.toy_channel and f"/{options.toy_channel}"

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - the model is in the body
        """Return the route."""
        return endpoint(base, "/toy", f"/chat{self.room}")
