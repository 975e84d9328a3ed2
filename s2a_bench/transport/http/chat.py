"""A chat completion in both of our HTTP servers: from a body to a request, from pieces to an answer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from s2a_bench.errors import RequestFailed, S2AError
from s2a_bench.facts import PROMPT_N
from s2a_bench.trace import Trace
from s2a_bench.transport.http import native
from s2a_bench.transport.limits import Limits, read_request, text
from s2a_bench.transport.pictures import decoded
from s2a_bench.transport.serving import Disconnected, Exchange
from s2a_bench.types import Action, Frame, Piece, Request
from s2a_bench.vectors import state_of

EVENTS = "text/event-stream; charset=utf-8"
Headers = Iterable[tuple[str, str]]
"""Names in lower case."""
Buffer = bytes | memoryview
Reads = Callable[[Headers, Buffer, Trace, Limits], tuple[Request, bool]]


def of_json(_headers: Headers, body: Buffer, trace: Trace, limits: Limits) -> tuple[Request, bool]:
    """Read an unvalidated JSON body; return the request, and whether its answer is streamed."""
    return of_fields(_parsed(bytes(body), "the body", trace), trace, limits, native.FAST)


def of_picture(headers: Headers, body: Buffer, trace: Trace, limits: Limits) -> tuple[Request, bool]:
    values = dict(headers)
    fields = _parsed(values.get(native.PARAMETERS_HEADER, "").encode(), f"header {native.PARAMETERS_HEADER}", trace)
    if not (isinstance(fields, dict) and isinstance(prompt := fields.get("prompt", ""), str)):
        raise RequestFailed(f"header {native.PARAMETERS_HEADER} should be an object whose prompt is text")
    images, pixels = list[Frame](), limits.pixels
    for kind, data in _cut(fields.get("pictures"), values.get("content-type", ""), body):
        images.append(decoded(kind, data, trace, pixels))
        pixels -= images[-1].pixel_count
    return _request(fields, prompt, tuple(images), limits)


def _parsed(document: bytes, what: str, trace: Trace) -> Any:
    try:
        fields = native.FAST.loads(document)
    except ValueError as error:
        raise RequestFailed(f"{what} is not JSON: {error}") from error
    trace.mark("json_parse")
    return fields


def _cut(pictures: Any, media_type: str, body: Buffer) -> list[tuple[str, Buffer]]:
    """Return the pictures of a body with their media types; raises RequestFailed unless they fill it."""
    if pictures is None:
        return [(media_type, body)] if body else []
    view, at = memoryview(body), 0
    blocks_of: list[tuple[str, Buffer]] = []
    try:
        for kind, size in pictures:
            if not (isinstance(kind, str) and type(size) is int and 0 < size <= len(view) - at):
                raise ValueError(f"{size!r} bytes of {kind!r} where {len(view) - at} are left")
            blocks_of.append((kind, view[at : at + size]))
            at += size
        if at != len(view):
            raise ValueError(f"{len(view) - at} bytes belong to no picture")
    except (TypeError, ValueError) as error:
        raise RequestFailed(f"pictures should be pairs of media type and bytes: {error}") from error
    return blocks_of


def of_fields(fields: Any, trace: Trace, limits: Limits, codec: native.Codec) -> tuple[Request, bool]:
    images, pixels = list[Frame](), limits.pixels
    texts: list[str] = []
    try:
        if not fields["messages"]:
            raise ValueError("there should be one at least")
        for message in fields["messages"]:
            content = message["content"]
            items: list[dict[str, Any]] = [{"type": "text", "text": content}] if isinstance(content, str) else content
            for part in items:
                if part["type"] != "image_url":
                    texts.append(part["text"])
                    continue
                media_type, encoded = native.split_data_uri(part["image_url"]["url"])
                data = codec.from_base64(encoded)
                trace.mark("base64_decode")
                images.append(decoded(media_type, data, trace, pixels))
                pixels -= images[-1].pixel_count
        prompt = "\n".join(texts)
    except (ValueError, KeyError, TypeError) as error:  # binascii.Error is a ValueError
        raise RequestFailed(f"messages: {error!r}") from error
    return _request(fields, prompt, tuple(images), limits)


def _request(fields: dict[str, Any], prompt: str, images: tuple[Frame, ...], limits: Limits) -> tuple[Request, bool]:
    name = text("request_id", fields.get("request_id")) or "chatcmpl-0"
    request = read_request(
        fields, limits, name, text("the prompt", prompt), images, state_of(fields.get("state") or ())
    )
    return request, bool(fields.get("stream"))


class ChatExchange(Exchange):
    """One chat completion; a server's framing adds `read`, `write` and `whole`."""

    parse_stage = "json_parse"
    takes_blocks = False
    """Whether the client reads actions as `native.Blocks`."""

    def __init__(self, codec: native.Codec, trace: Trace | None = None) -> None:
        super().__init__(trace)
        self._codec = codec
        self._request = Request("", "")
        self._streamed = False
        self._pieces: list[Piece] = []  # of an answer that is not streamed
        self._count = 0
        self._kind = ""  # media type of the answer that has begun

    def read(self) -> tuple[Request, bool]:
        """Parse and decode the request; return it, and whether its answer is streamed."""
        raise NotImplementedError

    def write(self, data: bytes, kind: str, *, last: bool) -> None:
        """Send a block of a streamed answer; ``kind`` is the media type with the first block, else empty."""
        raise NotImplementedError

    def whole(self, status: int, value: Any, headers: dict[str, str]) -> None:
        raise NotImplementedError

    def request(self) -> Request:
        self._request, self._streamed = self.read()
        return self._request

    def send(self, piece: Piece) -> bool:
        self._count += 1
        if not self._streamed:
            self._pieces.append(piece)
        elif not isinstance(piece, Action):
            event = native.stream_event(self._request.id, {"content": piece.text})
            event["choices"][0]["token"] = piece.id
            self._write(self._framed(event))
        elif self.takes_blocks:
            self._write(native.action_block(piece), native.BLOCKS)
        else:
            event = native.stream_event(self._request.id, {})
            event["choices"][0] |= {"tick": piece.index, "action": piece.values.tolist()}
            self._write(self._framed(event))
        if self.disconnected():
            raise Disconnected
        return True

    def end(self) -> None:
        if not self._streamed:
            self.sent_whole()
        request_id, marks = self._request.id, self.trace.to_remote().to_json()
        finish = "length" if self._count >= self._request.max_tokens else "stop"
        prompt = int(self.trace.facts.get(PROMPT_N, 0))
        usage = {"prompt_tokens": prompt, "completion_tokens": self._count, "total_tokens": prompt + self._count}
        if not self._streamed:
            message = {"role": "assistant", "content": content(self._pieces)}
            answer = {"id": request_id, "object": "chat.completion", "model": "s2a"}
            choice = {"index": 0, "message": message, "finish_reason": finish}
            self.whole(200, {**answer, "choices": [choice], "usage": usage, "s2a": marks}, {})
        elif self._kind == native.BLOCKS:
            self._write(self._framed(native.stream_event(request_id, {}, finish, s2a=marks)), last=True)
        else:
            end = (
                native.stream_event(request_id, {}, finish),
                native.stream_event(request_id, {}, usage=usage, s2a=marks),
            )
            self._write(b"".join(map(self._framed, end)) + b"data: [DONE]\n\n", last=True)

    def fail(self, error: S2AError) -> None:
        if self._kind:
            self._write(self._framed({"error": {"message": str(error), "type": type(error).__name__}}), last=True)
        else:
            status, message, headers = native.refusal_of(error)
            self.whole(status, native.error_json(status, message), headers)

    def _write(self, data: bytes, kind: str = EVENTS, *, last: bool = False) -> None:
        first, self._kind = not self._kind, self._kind or kind
        self.write(data, self._kind if first else "", last=last)

    def _framed(self, value: Any) -> bytes:
        if self._kind == native.BLOCKS:
            return native.json_block(value)
        return b"data: " + self._codec.dumps(value) + b"\n\n"


def content(pieces: Sequence[Piece]) -> str:
    """Return an answer as one text, actions as a JSON list."""
    acts = any(isinstance(piece, Action) for piece in pieces)
    return f"[{', '.join(piece.text for piece in pieces)}]" if acts else "".join(piece.text for piece in pieces)
