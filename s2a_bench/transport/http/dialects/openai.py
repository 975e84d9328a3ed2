"""OpenAI's ``chat/completions`` with server-sent events: clouds, TGI's chat route, llama-server, vLLM and our own.

*openai* sends standard fields only, as strict clouds refuse others. *llama-server* and *vllm* add what turns their
prompt cache off, and their names for a GBNF grammar.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from uuid import uuid4

from s2a_bench.transport.http import own as dialect
from s2a_bench.transport.http.dialects import OWN, Event, Picture
from s2a_bench.transport.http.dialects.common import Chat, endpoint, numbers, refuse_grammar, text_of, usage_of
from s2a_bench.types import Request

TIMINGS = {name: name for name in ("cache_n", "prompt_n", "prompt_ms", "predicted_n", "predicted_ms")}
"""What of llama-server's ``timings`` is kept."""

RATE = {"predicted_per_second": "rate"}

METRICS = {
    "time_to_first_token_ms": "first_token_ms",
    "generation_time_ms": "predicted_ms",
    "queue_time_ms": "queue_ms",
    "mean_itl_ms": "mean_itl_ms",
}
"""What of vLLM's per-request ``metrics`` is kept; its time to first token counts from when it was scheduled."""

TELLING = frozenset({"usage", "metrics", "timings"})


class OpenAI(Chat):
    """Any server of the dialect."""

    name = "openai"

    def url(self, base: str, model: str) -> str:  # noqa: ARG002 - other dialects have the model in the path
        """Return the chat route."""
        return endpoint(base, "/v1", "/chat/completions")

    def body(self, request: Request, pictures: list[Picture], model: str) -> dict[str, Any]:
        """Return standard fields and one user message."""
        extra = self._extra(request)
        uris = [dialect.data_uri(picture.media_type, picture.base64) for picture in pictures]
        return {**dialect.parameters(request, model), **extra, "messages": dialect.messages(request.prompt, uris)}

    def _extra(self, request: Request) -> dict[str, Any]:
        """Return the fields that are this server's own."""
        refuse_grammar(request, self.name)
        return {}

    def event(self, message: Any) -> Event:
        """Read one chunk; reasoning has two names."""
        text, thinking, finish = None, "", ""
        for choice in message.get("choices") or ():
            delta = choice.get("delta") or {}
            text = text_of(delta.get("content") or "") or None
            thinking = text_of(delta.get("reasoning_content") or delta.get("reasoning") or "")
            finish = text_of(choice.get("finish_reason") or "")
        if finish == "content_filter":
            return Event(error="the server's content filter ended the answer")
        return Event(text, -1, thinking, finish, self._facts(message))

    @staticmethod
    def _facts(message: dict[str, Any]) -> dict[str, float]:
        """Return what the usage chunk says, llama-server's and vLLM's own numbers last."""
        if not (message.keys() & TELLING):
            return {}
        usage = message.get("usage") or {}
        facts = {
            **usage_of(usage, {"prompt_tokens": "prompt_n", "completion_tokens": "predicted_n"}),
            **numbers(usage.get("prompt_tokens_details"), {"cached_tokens": "cache_n"}),
            **numbers(usage.get("completion_tokens_details"), {"reasoning_tokens": "thinking_n"}),
        }
        if "prompt_n" in facts:  # evaluated, as llama.cpp counts them
            facts["prompt_n"] -= facts.get("cache_n", 0.0)
        timings = numbers(message.get("timings"), TIMINGS | RATE)
        if rate := timings.pop("rate", 0.0):  # over n tokens or n - 1, as the build sees it
            timings["predicted_steps"] = float(round(rate * timings.get("predicted_ms", 0.0) / 1e3))
        return {**facts, **numbers(message.get("metrics"), METRICS), **timings}

    def starts_with_headers(self, facts: dict[str, float]) -> bool:
        """Tell a llama-server by its timings: it sends the headers when its slot starts."""
        return "prompt_ms" in facts


class LlamaServer(OpenAI):
    """llama.cpp's own server."""

    name = "llama-server"

    def _extra(self, request: Request) -> dict[str, Any]:
        return {"cache_prompt": False, **({"grammar": request.grammar} if request.grammar else {})}


class Vllm(OpenAI):
    """vLLM; its metrics come with ``--enable-per-request-metrics``."""

    name = "vllm"

    def _extra(self, request: Request) -> dict[str, Any]:
        """Keep prefixes apart by a salt of the request's own, and ask for metrics, which some versions want."""
        grammar = {"structured_outputs": {"grammar": request.grammar}} if request.grammar else {}
        return {"cache_salt": uuid4().hex, "include_metrics": True, **grammar}

    def event(self, message: Any) -> Event:
        """Read one chunk.

        An answer that ends by itself ends with a token that is counted and never shown; ``generation_time_ms`` is from
        the first token to the last, that one included.
        """
        event = super().event(message)
        facts = dict(event.facts)
        if event.finish == "stop":
            facts["end_n"] = 1.0
        if "predicted_ms" in facts and "predicted_n" in facts:
            facts["predicted_steps"] = facts["predicted_n"] - 1
        return replace(event, facts=facts)


class Own(OpenAI):
    """Our own server: it wants the request's id, and sends empty tokens, token ids and its marks."""

    name = OWN
    payloads = (*OpenAI.payloads, "raw")

    def _extra(self, request: Request) -> dict[str, Any]:
        return dialect.own_parameters(request)

    def event(self, message: Any) -> Event:
        """Read one chunk, the last of which carries the marks."""
        text, token_id, finish = None, -1, ""
        for choice in message.get("choices") or ():
            delta = choice.get("delta") or {}
            text = text_of(delta["content"]) if "content" in delta else None
            token_id = int(choice.get("token", -1))
            finish = text_of(choice.get("finish_reason") or "")
        remote = dialect.remote_of_json(message["s2a"]) if "s2a" in message else None
        return Event(text, token_id, finish=finish, remote=remote)
