"""From a body to a request: what each variant reads, marking each stage."""

from __future__ import annotations

from typing import Any

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Trace
from s2a_bench.transport.chunks import state_of
from s2a_bench.transport.http import own
from s2a_bench.transport.limits import SEEDS, Limits, text, whole_number
from s2a_bench.transport.pictures import decoded
from s2a_bench.types import Frame, Request

Headers = list[tuple[bytes, bytes]]
"""As ASGI has them: names in lower case."""
Buffer = bytes | memoryview


def of_json(headers: Headers, body: Buffer, trace: Trace, limits: Limits) -> tuple[Request, bool]:
    """Read a JSON body that nobody has validated; return the request, and whether its answer is streamed."""
    del headers
    try:
        fields = own.FAST.loads(body)
    except ValueError as error:
        raise RequestFailed(f"the body is no JSON: {error}") from error
    trace.mark("json_parse")
    return of_fields(fields, trace, limits, own.FAST)


def of_picture(headers: Headers, body: Buffer, trace: Trace, limits: Limits) -> tuple[Request, bool]:
    """Read a body that is the picture itself."""
    said = {name.decode("latin-1"): value.decode("latin-1") for name, value in reversed(headers)}
    try:
        fields = own.FAST.loads(said.get(own.PARAMETERS_HEADER, ""))
    except ValueError as error:
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} is no JSON: {error}") from error
    if not (isinstance(fields, dict) and isinstance(prompt := fields.get("prompt", ""), str)):
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} should be an object whose prompt is text")
    trace.mark("json_parse")
    pictures = _cut(fields.get("pictures"), said.get("content-type", ""), body)
    images = tuple(decoded(kind, data, trace, limits) for kind, data in pictures)
    return _request(fields, prompt, images, limits)


def _cut(pictures: Any, media_type: str, body: Buffer) -> list[tuple[str, Buffer]]:
    """Return the pictures of a body with their media types; raises RequestFailed where they are not the whole."""
    if pictures is None:
        return [(media_type, body)] if body else []
    view, at = memoryview(body), 0
    found: list[tuple[str, Buffer]] = []
    try:
        for kind, size in pictures:
            if not (isinstance(kind, str) and type(size) is int and 0 < size <= len(view) - at):
                raise ValueError(f"{size!r} bytes of {kind!r} where {len(view) - at} are left")
            found.append((kind, view[at : at + size]))
            at += size
        if at != len(view):
            raise ValueError(f"{len(view) - at} bytes are nobody's")
    except (TypeError, ValueError) as error:
        raise RequestFailed(f"pictures should be pairs of media type and bytes: {error}") from error
    return found


def of_fields(fields: Any, trace: Trace, limits: Limits, codec: own.Codec) -> tuple[Request, bool]:
    """Read OpenAI's fields and decode the pictures of the messages."""
    images: list[Frame] = []
    texts: list[str] = []
    try:
        for message in fields["messages"]:
            content = message["content"]
            parts: list[dict[str, Any]] = [{"type": "text", "text": content}] if isinstance(content, str) else content
            for part in parts:
                if part["type"] != "image_url":
                    texts.append(part["text"])
                    continue
                media_type, encoded = own.split_data_uri(part["image_url"]["url"])
                data = codec.from_base64(encoded)
                trace.mark("base64_decode")
                images.append(decoded(media_type, data, trace, limits))
        prompt = "\n".join(texts)
    except (ValueError, KeyError, TypeError) as error:  # binascii.Error is a ValueError
        raise RequestFailed(f"messages: {error!r}") from error
    return _request(fields, prompt, tuple(images), limits)


def _request(fields: dict[str, Any], prompt: str, images: tuple[Frame, ...], limits: Limits) -> tuple[Request, bool]:
    """Read the parameters."""
    request = Request(
        id=text("request_id", fields.get("request_id")) or "chatcmpl-0",
        prompt=text("the prompt", prompt),
        images=images,
        max_tokens=whole_number("max_tokens", fields.get("max_tokens"), 1, limits.answer_tokens, 32),
        grammar=text("grammar", fields.get("grammar")),
        seed=whole_number("seed", fields.get("seed"), 0, SEEDS, 0),
        state=state_of(fields.get("state") or ()),
    )
    return request, bool(fields.get("stream"))
