"""What real servers say, dialect by dialect, written from their sources, and what they demand."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from itertools import chain, islice
from typing import Any

import cv2
import numpy as np

from s2a_bench.errors import EngineError
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler
from s2a_bench.types import Frame, Request, Token
from tests.servers.sockets import Received, Reply, chunk, head, kept_head


class Speaker:
    """One dialect, spoken by a server."""

    dialect = ""
    kind = "text/event-stream"
    path = ""

    def read(self, received: Received) -> Request:
        """What was asked; raises for what the real server would refuse."""
        raise NotImplementedError

    def opening(self) -> bytes:
        """What comes before the first token."""
        return b""

    def token(self, token: Token) -> bytes:
        raise NotImplementedError

    def closing(self, tokens: list[Token]) -> bytes:
        """What comes after the last: reason, usage, timings."""
        raise NotImplementedError

    def bare_closing(self, _tokens: list[Token]) -> bytes:
        """The same without usage and timings."""
        raise NotImplementedError

    def thinking(self, text: str) -> bytes:
        raise NotImplementedError

    def error(self, message: str) -> bytes:
        """What comes instead of the rest when the model fails on the way."""
        raise NotImplementedError

    def refusal(self, _status: int, message: str) -> bytes:
        """The body of a 4xx or 5xx."""
        return compact({"error": message})


def compact(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False).encode()


def sse(value: Any) -> bytes:
    return b"data: " + compact(value) + b"\n\n"


def picture(data: str) -> Frame:
    """Decode a picture from Base64; raises for anything else."""
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data, validate=True), np.uint8), cv2.IMREAD_COLOR)
    rgb = np.ascontiguousarray(image[:, :, ::-1])
    return Frame(-1, 0, rgb.shape[1], rgb.shape[0], "rgb8", rgb)


DATA_URI = re.compile(r"data:image/(?:jpeg|png);base64,(.*)", re.DOTALL)
STANDARD_FIELDS = {"model", "stream", "stream_options", "max_tokens", "temperature", "top_p", "seed", "messages"}


class Cloud(Speaker):
    """A strict cloud in OpenAI's dialect: it refuses every field that it does not know."""

    dialect = "openai"
    kind = "text/event-stream; charset=utf-8"
    path = "/v1/chat/completions"
    extra: frozenset[str] = frozenset()

    def read(self, received: Received) -> Request:
        body = received.json
        assert set(body) <= STANDARD_FIELDS | self.extra, f"unknown fields {set(body) - STANDARD_FIELDS}"
        assert body["stream"] is True
        assert body["stream_options"] == {"include_usage": True}
        (message,) = body["messages"]
        assert message["role"] == "user"
        *images, text = message["content"]
        uris = [DATA_URI.fullmatch(image["image_url"]["url"]) for image in images]
        grammar = body.get("grammar") or body.get("structured_outputs", {}).get("grammar", "")
        frames = tuple(picture(uri[1]) for uri in uris if uri)
        return Request("", text["text"], frames, body["max_tokens"], grammar, body["seed"])

    def _chunk(self, delta: dict[str, Any], reason: str | None = None, **extra: Any) -> bytes:
        choices = [{"index": 0, "delta": delta, "finish_reason": reason, "logprobs": None}]
        return sse({"id": "c-1", "object": "chat.completion.chunk", "choices": choices, "usage": None, **extra})

    def opening(self) -> bytes:
        return self._chunk({"role": "assistant", "content": ""})

    def token(self, token: Token) -> bytes:
        return self._chunk({"content": token.text})

    def thinking(self, text: str) -> bytes:
        return self._chunk({"reasoning": text})

    def usage(self, tokens: list[Token]) -> dict[str, Any]:
        details = {"prompt_tokens_details": {"cached_tokens": 4}, "completion_tokens_details": {"reasoning_tokens": 0}}
        return {"usage": {"prompt_tokens": 12, "completion_tokens": len(tokens), **details}}

    def closing(self, tokens: list[Token]) -> bytes:
        last = sse({"id": "c-1", "object": "chat.completion.chunk", "choices": [], **self.usage(tokens)})
        return self._chunk({}, "stop") + last + b"data: [DONE]\n\n"

    def bare_closing(self, _tokens: list[Token]) -> bytes:
        return self._chunk({}, "length") + b"data: [DONE]\n\n"

    def error(self, message: str) -> bytes:
        return sse({"error": {"message": message, "type": "server_error", "code": None}})

    def refusal(self, status: int, message: str) -> bytes:
        return compact({"error": {"message": message, "type": "invalid_request_error", "code": status}})


class LlamaServer(Cloud):
    """llama.cpp's own: a role chunk with null, timings on the last chunk."""

    dialect = "llama-server"
    kind = "text/event-stream"
    extra = frozenset({"cache_prompt", "grammar"})

    def read(self, received: Received) -> Request:
        assert received.json["cache_prompt"] is False
        return super().read(received)

    def opening(self) -> bytes:
        progress = {"total": 218, "cache": 0, "processed": 64, "time_ms": 39}
        role: dict[str, Any] = {"role": "assistant", "content": None}
        return self._chunk(role) + self._chunk({"role": "assistant"}, prompt_progress=progress)

    def thinking(self, text: str) -> bytes:
        return self._chunk({"reasoning_content": text})

    def usage(self, tokens: list[Token]) -> dict[str, Any]:
        timings = {"cache_n": 3, "prompt_n": 9, "prompt_ms": 97.5, "predicted_n": len(tokens), "predicted_ms": 2.0}
        return {**super().usage(tokens), "timings": timings}


class Vllm(Cloud):
    """vLLM with ``--enable-per-request-metrics``."""

    dialect = "vllm"
    extra = frozenset({"cache_salt", "include_metrics", "structured_outputs"})

    def read(self, received: Received) -> Request:
        assert received.json["cache_salt"]
        return super().read(received)

    def usage(self, tokens: list[Token]) -> dict[str, Any]:
        times = {"time_to_first_token_ms": 31.5, "generation_time_ms": 80.0, "queue_time_ms": 0.25, "mean_itl_ms": 8.0}
        return {**super().usage(tokens), "metrics": {**times, "tokens_per_second": 125.0}}

    def error(self, message: str) -> bytes:
        return sse({"object": "error", "message": message, "type": "InternalServerError", "code": 500})


class Ollama(Speaker):
    """Ollama's native chat."""

    dialect = "ollama"
    kind = "application/x-ndjson"
    path = "/api/chat"

    def read(self, received: Received) -> Request:
        body = received.json
        assert set(body) == {"model", "stream", "options", "messages"}
        (message,) = body["messages"]
        options = body["options"]
        frames = tuple(picture(image) for image in message["images"])
        return Request("", message["content"], frames, options["num_predict"], "", options["seed"])

    def _line(self, message: dict[str, Any], **more: Any) -> bytes:
        return compact({"model": "m", "created_at": "2026-01-01T00:00:00Z", "message": message, **more}) + b"\n"

    def token(self, token: Token) -> bytes:
        return self._line({"role": "assistant", "content": token.text}, done=False)

    def thinking(self, text: str) -> bytes:
        return self._line({"role": "assistant", "content": "", "thinking": text}, done=False)

    def closing(self, tokens: list[Token]) -> bytes:
        counts = {"prompt_eval_count": 8, "eval_count": len(tokens)}
        times = {"total": 150_000_000, "load": 10_000_000, "prompt_eval": 100_000_000, "eval": 30_000_000}
        durations = {f"{name}_duration": duration for name, duration in times.items()}
        return self._line({"role": "assistant", "content": ""}, done_reason="stop", done=True, **counts, **durations)

    def bare_closing(self, _tokens: list[Token]) -> bytes:
        return self._line({"role": "assistant", "content": ""}, done=True)

    def error(self, message: str) -> bytes:
        return compact({"error": message}) + b"\n"


class Tgi(Speaker):
    """Text Generation Inference's native stream; its last token is in the closing event, here a special one."""

    dialect = "tgi"
    path = "/generate_stream"
    marked = re.compile(r"!\[\]\((data:image/[^)]*)\)")

    def read(self, received: Received) -> Request:
        body = received.json
        assert set(body) == {"inputs", "parameters"}
        uris = [DATA_URI.fullmatch(uri) for uri in self.marked.findall(body["inputs"])]
        frames = tuple(picture(uri[1]) for uri in uris if uri)
        parameters = body["parameters"]
        assert parameters["details"] is True
        prompt = self.marked.sub("", body["inputs"])
        return Request("", prompt, frames, parameters["max_new_tokens"], "", parameters["seed"])

    def _event(self, index: int, token: Token, text: str | None = None, **more: Any) -> bytes:
        special = token.text == "</s>"
        said = {"id": token.id, "text": token.text, "logprob": -0.5, "special": special}
        event = {"index": index, "token": said, "generated_text": text, "details": None, **more}
        return b"data:" + compact(event) + b"\n\n"

    def opening(self) -> bytes:
        return b":\n\n"

    def token(self, token: Token) -> bytes:
        return self._event(token.index + 1, token)

    def closing(self, tokens: list[Token]) -> bytes:
        details = {"finish_reason": "eos_token", "generated_tokens": len(tokens), "seed": 1, "input_length": 8}
        whole = "".join(token.text for token in tokens)
        return self._event(len(tokens) + 1, Token(0, "</s>", 2), whole, details=details)

    def bare_closing(self, tokens: list[Token]) -> bytes:
        return self._event(len(tokens) + 1, Token(0, "</s>", 2), "".join(token.text for token in tokens))

    def error(self, message: str) -> bytes:
        return b"data:" + compact({"error": message, "error_type": "generation"}) + b"\n\n"

    def refusal(self, _status: int, message: str) -> bytes:
        return compact({"error": message, "error_type": "validation"})


class Gemini(Speaker):
    """Google's; the last chunk may carry text, and the body's end is the stream's."""

    dialect = "gemini"
    path = "/v1beta/models/default:streamGenerateContent?alt=sse"

    def read(self, received: Received) -> Request:
        body = received.json
        assert set(body) == {"contents", "generationConfig"}
        ((turn,), settings) = body["contents"], body["generationConfig"]
        assert turn["role"] == "user"
        *images, text = turn["parts"]
        assert all(image["inline_data"]["mime_type"] in {"image/jpeg", "image/png"} for image in images)
        frames = tuple(picture(image["inline_data"]["data"]) for image in images)
        return Request("", text["text"], frames, settings["maxOutputTokens"], "", settings["seed"])

    def _chunk(self, parts: list[dict[str, Any]], usage: dict[str, int], **more: Any) -> bytes:
        candidate = {"content": {"parts": parts, "role": "model"}, "index": 0, **more}
        value = {"candidates": [candidate], "usageMetadata": usage, "modelVersion": "g", "responseId": "r"}
        return b"data: " + compact(value) + b"\r\n\r\n"

    def token(self, token: Token) -> bytes:
        return self._chunk([{"text": token.text}], {"promptTokenCount": 8, "totalTokenCount": 8 + token.index})

    def thinking(self, text: str) -> bytes:
        return self._chunk([{"text": text, "thought": True}], {"promptTokenCount": 8, "thoughtsTokenCount": 1})

    def closing(self, tokens: list[Token]) -> bytes:
        usage = {"promptTokenCount": 8, "candidatesTokenCount": len(tokens), "totalTokenCount": 8 + len(tokens)}
        return self._chunk([{"text": ""}], usage, finishReason="STOP")

    def bare_closing(self, _tokens: list[Token]) -> bytes:
        return b'data: {"candidates":[{"finishReason":"MAX_TOKENS"}]}\r\n\r\n'

    def error(self, message: str) -> bytes:
        error = {"code": 503, "message": message, "status": "UNAVAILABLE"}
        return json.dumps({"error": error}, indent=2).encode() + b"\n"

    def refusal(self, status: int, message: str) -> bytes:
        return json.dumps([{"error": {"code": status, "message": message, "status": "X"}}], indent=2).encode()


SPEAKERS: tuple[Speaker, ...] = (Cloud(), LlamaServer(), Vllm(), Ollama(), Tgi(), Gemini())


def answering(speaker: Speaker, handler: Handler) -> Reply:
    """Speak for a handler, as the real server does for its model; requests it would refuse are 400s."""

    def reply(received: Received) -> Iterator[bytes]:
        try:
            assert (received.method, received.path) == ("POST", speaker.path), f"no route {received.path}"
            tokens = handler(speaker.read(received), Trace())
            first = list(islice(tokens, 1))
        except (AssertionError, EngineError, KeyError, ValueError) as error:
            if speaker.dialect == Tgi.dialect:  # its stream has begun, whatever comes of it
                yield head(kind=speaker.kind) + speaker.error(str(error))
            else:
                yield head("400 Bad Request", "application/json") + speaker.refusal(400, str(error))
            return
        said: list[Token] = []
        yield kept_head(speaker.kind)
        if speaker.opening():
            yield chunk(speaker.opening())
        try:
            for token in chain(first, tokens):
                said.append(token)
                yield chunk(speaker.token(token))
            yield chunk(speaker.closing(said))
        except EngineError as error:
            yield chunk(speaker.error(str(error)))
        yield chunk(b"")

    return reply
