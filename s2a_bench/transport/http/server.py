"""The HTTP server on FastAPI and uvicorn: one application, one path per variant, around one handler.

*As deployed* is written as llama-cpp-python's own server and most robot code are: a pydantic body, the standard
library's Base64, a synchronous endpoint in the thread pool, which pulls the first token before it answers so that an
error still gets its status code. *Best effort* and *binary* skip validation and use fast libraries.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, StrictInt
from starlette.requests import ClientDisconnect

from s2a_bench.errors import BadRequest, Busy, EngineError, Overdue, PortInUse, RequestFailed, S2AError, UsageError
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.http import own
from s2a_bench.transport.http.access import key_for, keyed
from s2a_bench.transport.http.answer import Answer
from s2a_bench.transport.http.door import door
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import SEEDS, Limits, text, whole_number
from s2a_bench.transport.pictures import decoded
from s2a_bench.transport.turns import Queued
from s2a_bench.types import Frame, Request

KEEP_ALIVE_S = 3600
"""A client that waits for its turn in an interleaved run keeps its connection."""


STUCK_S = 120
"""Silence of an answer under way after which /health says so: a long prompt on a small board takes its time."""


STATUSES = ((Busy, 503), (Overdue, 504), (BadRequest, 400), (EngineError, 500))
"""By what an error is, the first that fits; every other one is 400."""


class ImageUrl(BaseModel):
    """Where a picture is: a data URI."""

    url: str


class Part(BaseModel):
    """One part of a message: text or a picture."""

    type: Literal["text", "image_url"]
    text: str = ""
    image_url: ImageUrl | None = None


class Message(BaseModel):
    """One message of the conversation."""

    role: str
    content: str | list[Part]


class ChatRequest(BaseModel):
    """The body of ``POST /v1/chat/completions``, as far as it is understood here."""

    messages: list[Message]
    stream: bool = False
    max_tokens: StrictInt | None = None
    grammar: str = ""
    seed: StrictInt | None = None
    request_id: str = "chatcmpl-0"


def _received(app: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """Wrap an ASGI application so that the last byte of a body ends the stage `network`."""

    async def wrapped(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        trace = Trace()
        scope.setdefault("state", {})["trace"] = trace

        async def timed_receive() -> Any:
            event = await receive()
            if event["type"] == "http.request" and not event.get("more_body") and not trace.marks:
                trace.mark("network")
            return event

        try:
            with suppress(asyncio.CancelledError, ClientDisconnect):  # uvicorn cancels what is under way when it stops
                await app(scope, timed_receive, send)
        finally:
            if answer := scope["state"].get("answer"):
                answer.abandon()  # whatever was raised, wherever: the engine is free again

    return wrapped


def application(queued: Queued, limits: Limits, *, documented: bool = False) -> FastAPI:
    """Build the application: chat completions in three variants, and what tools expect beside them."""
    app = FastAPI(title="s2a-bench", openapi_url="/openapi.json" if documented else None)  # /docs and /redoc follow it
    app.state.queued, app.state.limits = queued, limits

    @app.exception_handler(S2AError)
    async def refuse(_: HttpRequest, error: S2AError) -> Response:
        headers = {"Retry-After": f"{error.retry_after_s:.0f}"} if isinstance(error, Busy) else None
        return _error(next((status for kind, status in STATUSES if isinstance(error, kind)), 400), str(error), headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: HttpRequest, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        return _error(400, f"{'.'.join(str(step) for step in first['loc'])}: {first['msg']}")

    @app.get("/health")
    async def health() -> Response:
        silent_s = queued.turns.silent_s()
        if silent_s > STUCK_S:
            said = f"the answer under way has shown no sign of life for {silent_s:.0f} s"
            return JSONResponse({"status": "stuck", "reason": said}, 503)
        return JSONResponse({"status": "ok"})

    @app.get("/v1/models")
    def models() -> dict[str, Any]:
        model = {"id": "s2a", "object": "model", "owned_by": "s2a-bench", "s2a_provenance": queued.provenance}
        return {"object": "list", "data": [model]}

    @app.post(own.PATHS[own.AS_DEPLOYED])
    def as_deployed(body: ChatRequest, http_request: HttpRequest) -> Response:
        http_request.state.trace.mark("json_parse")
        return _answer(body.model_dump(), http_request, own.STANDARD)

    async def best_effort(http_request: HttpRequest) -> Response:
        body = await http_request.body()
        return await run_in_threadpool(_answer_json, body, http_request)

    async def binary(http_request: HttpRequest) -> Response:
        body = await http_request.body()
        return await run_in_threadpool(_answer_binary, body, http_request)

    app.add_route(own.PATHS[own.BEST_EFFORT], best_effort, methods=["POST"])
    app.add_route(own.PATHS[own.BINARY], binary, methods=["POST"])
    return app


def _answer_json(body: bytes, http_request: HttpRequest) -> Response:
    """Answer a JSON body that nobody has validated."""
    try:
        fields = own.FAST.loads(body)
    except ValueError as error:
        raise RequestFailed(f"the body is no JSON: {error}") from error
    http_request.state.trace.mark("json_parse")
    return _answer(fields, http_request, own.FAST)


def _answer_binary(body: bytes, http_request: HttpRequest) -> Response:
    """Answer a body that is the picture itself."""
    trace: Trace = http_request.state.trace
    try:
        fields = own.FAST.loads(http_request.headers.get(own.PARAMETERS_HEADER, ""))
    except ValueError as error:
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} is no JSON: {error}") from error
    if not (isinstance(fields, dict) and isinstance(prompt := fields.get("prompt", ""), str)):
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} should be an object whose prompt is text")
    trace.mark("json_parse")
    images = (
        (decoded(http_request.headers.get("content-type", ""), body, trace, http_request.app.state.limits),)
        if body
        else ()
    )
    return _respond(fields, prompt, images, http_request, own.FAST)


def _answer(fields: dict[str, Any], http_request: HttpRequest, codec: own.Codec) -> Response:
    """Decode the pictures of the messages and answer."""
    trace: Trace = http_request.state.trace
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
                media_type, text = own.split_data_uri(part["image_url"]["url"])
                data = codec.from_base64(text)
                trace.mark("base64_decode")
                images.append(decoded(media_type, data, trace, http_request.app.state.limits))
        prompt = "\n".join(texts)
    except (ValueError, KeyError, TypeError) as error:  # binascii.Error is a ValueError
        raise RequestFailed(f"messages: {error!r}") from error
    return _respond(fields, prompt, tuple(images), http_request, codec)


def _respond(
    fields: dict[str, Any],
    prompt: str,
    images: tuple[Frame, ...],
    http_request: HttpRequest,
    codec: own.Codec,
) -> Response:
    """Join the queue, and begin if nobody is before us, so that a refusal still has its status code."""
    trace: Trace = http_request.state.trace
    queued, limits = http_request.app.state.queued, http_request.app.state.limits
    request = Request(
        id=text("request_id", fields.get("request_id")) or "chatcmpl-0",
        prompt=text("the prompt", prompt),
        images=images,
        max_tokens=whole_number("max_tokens", fields.get("max_tokens"), 1, limits.answer_tokens, 32),
        grammar=text("grammar", fields.get("grammar")),
        seed=whole_number("seed", fields.get("seed"), 0, SEEDS, 0),
    )
    answer = http_request.state.answer = Answer(queued, request, trace, codec, stream=bool(fields.get("stream")))
    answer.begin()
    return answer


def _error(status: int, message: str, headers: dict[str, str] | None = None) -> Response:
    """Answer an error in OpenAI's form."""
    shown = message.encode(errors="backslashreplace").decode()
    body = {"error": {"message": shown, "type": "invalid_request_error", "code": status}}
    return JSONResponse(body, status, headers)


class _Server(uvicorn.Server):
    """uvicorn without its signal handlers: whoever runs the server has some."""

    def capture_signals(self) -> AbstractContextManager[None]:  # type: ignore[override]
        return nullcontext()


class HttpServer:
    """uvicorn on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was, without it 127.0.0.1 and any port.

        Raises PortInUse, and UsageError where others than this machine would need no key and nobody said so.
        """
        host, _, port = (wiring.address.removeprefix("http://") or "127.0.0.1:0").rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host or "127.0.0.1", int(port)))
            key = key_for(self._socket.getsockname()[0], wiring.options)
            self._socket.listen()  # only now is the port ours
        except UsageError:
            self._socket.close()
            raise
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise PortInUse(f"`port`: {port} is in use on {host}; choose another, or 0 for any free one") from error
            raise PortInUse(f"`port`: cannot bind {host}:{port}: {error.strerror}") from error
        self.address = "http://{}:{}".format(*self._socket.getsockname())
        queued = Queued.around(handler, wiring.limits)
        app = application(queued, wiring.limits, documented=wiring.options.api_docs)
        config = uvicorn.Config(
            keyed(_received(app), key),
            loop="uvloop",
            http=door(wiring.limits),
            log_level="warning",
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
            timeout_keep_alive=KEEP_ALIVE_S,
        )
        self._server = _Server(config)

    def describe(self) -> dict[str, str | int]:
        """Say what serves."""
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "httptools"}

    def serve(self) -> None:
        """Serve until stopped."""
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Finish the requests under way, for a second at most."""
        self._server.should_exit = True
