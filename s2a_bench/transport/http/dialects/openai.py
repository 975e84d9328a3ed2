"""OpenAI's ``chat/completions`` with server-sent events: clouds, TGI's chat route, llama-server, vLLM and our server.

*openai* sends standard fields only, because strict clouds refuse others. *llama-server* and *vllm* add the fields that
turn their prompt caches off, and their names for a GBNF grammar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import Any
from uuid import uuid4

from s2a_bench.facts import (
    CACHE_N,
    END_N,
    LATENCY_DRAWN_MS,
    LLAMA,
    PREDICTED_MS,
    PREDICTED_N,
    PREDICTED_STEPS,
    PROMPT_MS,
    PROMPT_N,
    THINKING_N,
    USAGE_ZERO,
    Fact,
)
from s2a_bench.trace import Remote
from s2a_bench.transport.http import native
from s2a_bench.transport.http.dialects import NATIVE, EncodedPicture, Event
from s2a_bench.transport.http.dialects.common import Dialect, evaluated, numbers, text_of, token_id, usage_of
from s2a_bench.transport.limits import whole_number
from s2a_bench.types import Action, Request
from s2a_bench.vectors import NUMBERS as TICKS
from s2a_bench.vectors import actions_of

TIMINGS = {str(fact): fact for fact in (CACHE_N, PROMPT_N, PROMPT_MS, PREDICTED_N, PREDICTED_MS)}

RATE = Fact("predicted_per_second", "tokens/s", "becomes `predicted_steps`")

METRICS = {
    "time_to_first_token_ms": Fact("first_token_ms", "ms", "request scheduled to first token"),
    "generation_time_ms": PREDICTED_MS,
    "queue_time_ms": Fact("queue_ms", "ms", "waiting to be scheduled"),
    "mean_itl_ms": Fact("mean_itl_ms", "ms", "mean gap between tokens"),
}

USAGE = {"prompt_tokens": PROMPT_N, "completion_tokens": PREDICTED_N}
CACHED = {"cached_tokens": CACHE_N}
REASONING = {"reasoning_tokens": THINKING_N}

WITH_FACTS = frozenset({"usage", "metrics", "timings"})


class OpenAI(Dialect):
    name = "openai"
    root, path = "/v1", "/chat/completions"
    facts = (*TIMINGS.values(), *METRICS.values(), THINKING_N, PREDICTED_STEPS, USAGE_ZERO)

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:
        uris = [f"data:{picture.media_type};base64,{picture.base64}" for picture in pictures]
        content: list[Any] = [{"type": "image_url", "image_url": {"url": uri}} for uri in uris]
        content.append({"type": "text", "text": request.prompt})
        messages = [{"role": "user", "content": content}]
        return {**native.parameters(request, model), **self._extra(request), "messages": messages}

    def _extra(self, request: Request) -> dict[str, Any]:  # noqa: ARG002 - for subclasses
        return {}

    def event(self, message: Any) -> Event:
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
        if not (message.keys() & WITH_FACTS):
            return {}
        usage = message.get("usage") or {}
        facts = {
            **usage_of(usage, USAGE),
            **numbers(usage.get("prompt_tokens_details"), CACHED),
            **numbers(usage.get("completion_tokens_details"), REASONING),
        }
        timings = numbers(message.get("timings"), TIMINGS | {RATE: RATE})
        if rate := timings.pop(RATE, 0.0):  # over n tokens or n - 1, depending on the build
            steps = rate * timings.get(PREDICTED_MS, 0.0) / 1e3
            timings[PREDICTED_STEPS] = float(round(steps)) if isfinite(steps) else steps
        return {**evaluated(facts), **numbers(message.get("metrics"), METRICS), **timings}

    def starts_with_headers(self, facts: dict[str, float]) -> bool:
        """Recognise a llama-server by its timings: it sends the headers when its slot starts."""
        return PROMPT_MS in facts


class LlamaServer(OpenAI):
    name = "llama-server"
    takes_grammar = True

    def _extra(self, request: Request) -> dict[str, Any]:
        # a repeated picture hits the KV cache: 40 ms to the first token instead of 136 (a tiny model)
        return {"cache_prompt": False, **({"grammar": request.grammar} if request.grammar else {})}


class Vllm(OpenAI):
    """vLLM; its metrics come with ``--enable-per-request-metrics``."""

    name = "vllm"
    takes_grammar = True
    facts = (*OpenAI.facts, END_N)

    def _extra(self, request: Request) -> dict[str, Any]:
        """Separate prefixes by a new salt for each request, and request metrics, as some versions require."""
        grammar = {"structured_outputs": {"grammar": request.grammar}} if request.grammar else {}
        return {"cache_salt": uuid4().hex, "include_metrics": True, **grammar}

    def event(self, message: Any) -> Event:
        """Read one message.

        An answer that ends by itself has a last token that is counted and never sent; ``generation_time_ms`` is from
        the first token to that one.
        """
        event = super().event(message)
        facts = dict(event.facts)
        if event.finish == "stop":
            facts[END_N] = 1.0
        if PREDICTED_MS in facts and PREDICTED_N in facts:
            facts[PREDICTED_STEPS] = facts[PREDICTED_N] - 1
        return replace(event, facts=facts)


class Native(OpenAI):
    """Our server: it takes the request's id, and sends empty tokens, token ids and its marks."""

    name = NATIVE
    takes_grammar = True
    facts = (*LLAMA, LATENCY_DRAWN_MS)  # our engines behind it
    payloads = (*OpenAI.payloads, "raw")

    def _extra(self, request: Request) -> dict[str, Any]:
        return native.native_parameters(request)

    def event(self, message: Any) -> Event:
        text, token, finish = None, -1, ""
        actions: Sequence[Action] = ()
        for choice in message.get("choices") or ():
            if "action" in choice:
                actions = actions_of(choice["action"], whole_number("index", choice.get("tick"), 0, TICKS, 0))
            elif "actions" in choice:  # as `native.read_block` returns them
                actions = choice["actions"]
            delta = choice.get("delta") or {}
            text = text_of(delta["content"]) if "content" in delta else None
            token = token_id(choice.get("token"))
            finish = text_of(choice.get("finish_reason") or "")
        remote = Remote.of_json(message["s2a"]) if "s2a" in message else None
        return Event(text, token, finish=finish, remote=remote, actions=actions)
