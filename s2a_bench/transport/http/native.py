"""The wire format of our HTTP server: request bodies and streamed events, without any I/O.

The dialect is OpenAI's ``chat/completions`` with Server-Sent Events and three optional additions: the media type
``application/x-raw`` for uncompressed pixels, the fields ``grammar`` (as in llama-server) and ``request_id``, and in
the last event the key ``s2a`` with the server's marks.

Answers of *binary* with actions are blocks: each action as bytes, the end or an error as a block of JSON. A block is
the length of what follows (uint32), then b"A", the tick (uint32) and the float32 of one action, or b"J" and JSON; all
little endian.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final

import numpy as np
import orjson
import pybase64

from s2a_bench.errors import BadRequest, Busy, EngineError, Overdue, S2AError, TooLarge
from s2a_bench.transport.access import Access
from s2a_bench.transport.http import VARIANTS
from s2a_bench.transport.http.dialects.common import sampled
from s2a_bench.transport.serving import Core, Queued
from s2a_bench.types import Action, Request
from s2a_bench.vectors import actions_of

AS_DEPLOYED, BEST_EFFORT, BINARY, LLAMA_SERVER = VARIANTS

PATHS = {
    AS_DEPLOYED: "/v1/chat/completions",
    BEST_EFFORT: "/best-effort/v1/chat/completions",
    BINARY: "/binary/v1/chat/completions",
}

SCHEME = "Bearer"
HEALTH, MODELS = "/health", "/v1/models"
KEEP_ALIVE_S: Final = 3600
"""A client that waits for its turn in an interleaved run keeps its connection."""

PARAMETERS_HEADER = "s2a-request"
"""Binary variant: this header has the parameters as ASCII JSON, the body the picture's bytes."""
BLOCKS: Final = "application/x-s2a-actions"
LENGTH: Final = struct.Struct("<I")
ACTION_BLOCK, JSON_BLOCK = b"A", b"J"


@dataclass(frozen=True, slots=True)
class Codec:
    dumps: Callable[[Any], bytes]
    loads: Callable[[Any], Any]
    to_base64: Callable[[Any], str]
    from_base64: Callable[[str], bytes]


STANDARD = Codec(
    dumps=lambda value: json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode(),
    loads=json.loads,
    to_base64=lambda data: base64.b64encode(data).decode("ascii"),
    from_base64=base64.b64decode,
)
# validate=True is pybase64's fast path: 0.06 ms instead of 0.35 ms for a VGA frame
FAST = Codec(
    dumps=orjson.dumps,
    loads=orjson.loads,
    to_base64=pybase64.b64encode_as_string,
    from_base64=lambda text: pybase64.b64decode(text, validate=True),
)
CODECS = {AS_DEPLOYED: STANDARD, BEST_EFFORT: FAST, BINARY: FAST, LLAMA_SERVER: STANDARD}


STATUSES = ((Busy, 503), (TooLarge, 413), (Overdue, 504), (BadRequest, 400), (EngineError, 500))
"""Kinds of errors and their statuses; the first match counts."""


def refusal_of(error: S2AError) -> tuple[int, str, dict[str, str]]:
    status = next((status for kind, status in STATUSES if isinstance(error, kind)), 400)
    headers = {"retry-after": f"{error.retry_after_s:.0f}"} if isinstance(error, Busy) else {}
    return status, str(error), headers


def error_json(status: int, message: str) -> dict[str, Any]:
    return {"error": {"message": message, "type": "invalid_request_error", "code": status}}


def head_of(status: int, headers: Mapping[str, str], *, keep: bool) -> bytes:
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", *(f"{name}: {value}" for name, value in headers.items())]
    return "\r\n".join([*lines, *([] if keep else ["connection: close"]), "", ""]).encode()


def json_answer(status: int, value: Any, headers: Mapping[str, str] | None = None, *, keep: bool) -> bytes:
    body = FAST.dumps(value)
    headers = {"content-type": "application/json", **(headers or {}), "content-length": str(len(body))}
    return head_of(status, headers, keep=keep) + body


class Refused(Exception):
    """A request is refused, and its connection closed: the next bytes are unknown."""

    def __init__(self, status: int, message: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.status, self.headers = status, headers or {}

    @property
    def answer(self) -> bytes:
        return json_answer(self.status, error_json(self.status, str(self)), self.headers, keep=False)


def admit(access: Access, path: str, headers: Iterable[tuple[str, str]]) -> None:
    """Raise Refused for a request that ``access`` refuses; the names of its headers are in lower case."""
    if refusal := access.refusal(path == HEALTH, headers):
        status, message = refusal
        raise Refused(status, message, {"www-authenticate": SCHEME} if status == HTTPStatus.UNAUTHORIZED else None)


def health(core: Core) -> tuple[int, dict[str, str]]:
    stuck = core.stuck()
    return (503, {"status": "stuck", "reason": stuck}) if stuck else (200, {"status": "ok"})


def models(queued: Queued) -> dict[str, Any]:
    model = {"id": "s2a", "object": "model", "owned_by": "s2a-bench", "s2a_provenance": queued.provenance}
    return {"object": "list", "data": [model]}


def split_data_uri(uri: str) -> tuple[str, str]:
    """Return the media type and the Base64 text of a data URI (RFC 2397); ValueError for anything else."""
    head, comma, encoded = uri.partition(",")
    if not (comma and head.startswith("data:") and head.endswith(";base64")):
        raise ValueError(f"image_url.url should be a data:...;base64,... URI, not '{uri[:40]}...'")
    return head[len("data:") : -len(";base64")], encoded


def parameters(request: Request, model: str) -> dict[str, Any]:
    """Return the request's standard fields apart from the messages."""
    return {
        "model": model,
        "stream": True,
        "stream_options": {"include_usage": True},
        **sampled(request),
    }


def native_parameters(request: Request) -> dict[str, Any]:
    """Return the fields that only our server knows."""
    optional = {"grammar": request.grammar, "state": request.state}
    return {"request_id": request.id, **{name: value for name, value in optional.items() if value}}


def stream_event(
    request_id: str, delta: dict[str, str], finish_reason: str | None = None, **extra: Any
) -> dict[str, Any]:
    """Return one streamed event; the last one has ``usage`` and no choices."""
    choices = [] if "usage" in extra else [{"index": 0, "delta": delta, "finish_reason": finish_reason}]
    return {"id": request_id, "object": "chat.completion.chunk", "model": "s2a", "choices": choices, **extra}


def action_block(action: Action) -> bytes:
    block = ACTION_BLOCK + LENGTH.pack(action.index) + action.values.astype("<f4").tobytes()
    return LENGTH.pack(len(block)) + block


def json_block(message: Any) -> bytes:
    block = JSON_BLOCK + orjson.dumps(message)
    return LENGTH.pack(len(block)) + block


def read_block(block: bytes) -> Any:
    """Return a block's content as a message of the native dialect; raises ValueError or RequestFailed."""
    if block[:1] == JSON_BLOCK:
        return orjson.loads(block[1:])
    if block[:1] != ACTION_BLOCK or len(block) <= 1 + LENGTH.size or (len(block) - 1 - LENGTH.size) % 4:
        raise ValueError("a block that is neither an action nor JSON")
    (index,) = LENGTH.unpack_from(block, 1)
    values = np.frombuffer(block, "<f4", offset=1 + LENGTH.size)
    return {"choices": [{"actions": actions_of(values, index)}]}


class Blocks:
    """A framing that cuts a body into blocks, see `dialects.framing`."""

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        self._held += data
        while len(self._held) >= LENGTH.size:
            (size,) = LENGTH.unpack_from(self._held)
            if len(self._held) < LENGTH.size + size:
                return
            block = bytes(self._held[LENGTH.size : LENGTH.size + size])
            del self._held[: LENGTH.size + size]
            yield block

    def end(self) -> Iterator[bytes]:
        """Yield nothing; raises ValueError for a truncated block."""
        if self._held:
            raise ValueError("a block that is cut off")
        yield from ()
