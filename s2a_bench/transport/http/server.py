"""The HTTP server on FastAPI and uvicorn: one application, one path per variant, around one handler.

*As deployed* is written as llama-cpp-python's own server and most robot code are: a pydantic body, the standard
library's Base64, a synchronous endpoint in the thread pool, which pulls the first token before it answers so that an
error still gets its status code. *Best effort* and *binary* skip validation and use fast libraries.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Iterator
from contextlib import closing, suppress
from itertools import chain
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from pydantic import BaseModel

from s2a_bench.errors import EngineError, PortInUse, RequestFailed, S2AError
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.http import own
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.pictures import decoded
from s2a_bench.types import Frame, Request, Token

KEEP_ALIVE_S = 3600
"""A client that waits for its turn in an interleaved run keeps its connection."""


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
    max_tokens: int = 32
    grammar: str = ""
    seed: int = 0
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

        with suppress(asyncio.CancelledError):  # uvicorn cancels what is under way when it stops: no error of ours
            await app(scope, timed_receive, send)

    return wrapped


def application(handler: Handler) -> FastAPI:
    """Build the application: chat completions in three variants, and what tools expect beside them."""
    app = FastAPI(title="s2a-bench", docs_url=None, redoc_url=None)

    @app.exception_handler(S2AError)
    async def refuse(_: HttpRequest, error: S2AError) -> Response:
        return _error(500 if isinstance(error, EngineError) else 400, str(error))

    @app.exception_handler(RequestValidationError)
    async def invalid(_: HttpRequest, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        return _error(422, f"{'.'.join(str(step) for step in first['loc'])}: {first['msg']}")

    @app.get("/health")
    def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/v1/models")
    def models() -> dict[str, Any]:
        return {"object": "list", "data": [{"id": "s2a", "object": "model", "owned_by": "s2a-bench"}]}

    @app.post(own.PATHS[own.AS_DEPLOYED])
    def as_deployed(body: ChatRequest, http_request: HttpRequest) -> Response:
        trace: Trace = http_request.state.trace
        trace.mark("json_parse")
        return _answer(handler, body.model_dump(), trace, own.STANDARD)

    async def best_effort(http_request: HttpRequest) -> Response:
        body = await http_request.body()
        return await run_in_threadpool(_answer_json, handler, body, http_request.state.trace)

    async def binary(http_request: HttpRequest) -> Response:
        body = await http_request.body()
        return await run_in_threadpool(_answer_binary, handler, body, http_request)

    app.add_route(own.PATHS[own.BEST_EFFORT], best_effort, methods=["POST"])
    app.add_route(own.PATHS[own.BINARY], binary, methods=["POST"])
    return app


def _answer_json(handler: Handler, body: bytes, trace: Trace) -> Response:
    """Answer a JSON body that nobody has validated."""
    try:
        fields = own.FAST.loads(body)
    except ValueError as error:
        raise RequestFailed(f"the body is no JSON: {error}") from error
    trace.mark("json_parse")
    return _answer(handler, fields, trace, own.FAST)


def _answer_binary(handler: Handler, body: bytes, http_request: HttpRequest) -> Response:
    """Answer a body that is the picture itself."""
    trace: Trace = http_request.state.trace
    try:
        fields = own.FAST.loads(http_request.headers.get(own.PARAMETERS_HEADER, ""))
    except ValueError as error:
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} is no JSON: {error}") from error
    if not (isinstance(fields, dict) and isinstance(prompt := fields.get("prompt", ""), str)):
        raise RequestFailed(f"header {own.PARAMETERS_HEADER} should be an object whose prompt is text")
    trace.mark("json_parse")
    images = (decoded(http_request.headers.get("content-type", ""), body, trace),) if body else ()
    return _respond(handler, fields, prompt, images, trace, own.FAST)


def _answer(handler: Handler, fields: dict[str, Any], trace: Trace, codec: own.Codec) -> Response:
    """Decode the pictures of the messages and answer."""
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
                images.append(decoded(media_type, data, trace))
        prompt = "\n".join(texts)
    except (ValueError, KeyError, TypeError) as error:  # binascii.Error is a ValueError
        raise RequestFailed(f"messages: {error!r}") from error
    return _respond(handler, fields, prompt, tuple(images), trace, codec)


def _respond(
    handler: Handler,
    fields: dict[str, Any],
    prompt: str,
    images: tuple[Frame, ...],
    trace: Trace,
    codec: own.Codec,
) -> Response:
    """Start the answer, so that a refusal still has its status code, then stream it or send it whole."""
    try:
        request = Request(
            id=str(fields.get("request_id") or "chatcmpl-0"),
            prompt=prompt,
            images=images,
            max_tokens=int(fields.get("max_tokens") or 32),
            grammar=str(fields.get("grammar") or ""),
            seed=int(fields.get("seed") or 0),
        )
    except (ValueError, TypeError) as error:
        raise RequestFailed(f"max_tokens, seed: {error}") from error
    tokens = handler(request, trace)
    first = list(next_of(tokens))
    if fields.get("stream"):
        events = _events(request, chain(first, tokens), trace, codec)
        return StreamingResponse(_relayed(events), media_type="text/event-stream")
    whole = [*first, *tokens]
    return JSONResponse(
        {
            "id": request.id,
            "object": "chat.completion",
            "model": "s2a",
            "choices": [
                {
                    "index": 0,
                    "message": {"role": "assistant", "content": "".join(token.text for token in whole)},
                    "finish_reason": _finish_reason(request, len(whole)),
                }
            ],
            "usage": _usage(trace, len(whole)),
            "s2a": own.remote_json(trace.to_remote()),
        }
    )


async def _relayed(events: Generator[bytes, None, None]) -> AsyncIterator[bytes]:
    """Run an answer on one thread and yield what it has written since: a thread's turn a token would cost 50 us each.

    When the client has gone, the answer ends at its next event, on its thread: ending may wait for the engine.
    """
    loop, written, waiting = asyncio.get_running_loop(), asyncio.Event(), deque[bytes]()
    gone = False

    def run() -> None:
        with closing(events):
            for event in events:
                waiting.append(event)
                if gone:
                    return
                loop.call_soon_threadsafe(written.set)

    answer = asyncio.ensure_future(run_in_threadpool(run))
    answer.add_done_callback(lambda _: written.set())
    try:
        while not answer.done() or waiting:
            await written.wait()
            written.clear()
            if pieces := [waiting.popleft() for _ in range(len(waiting))]:
                yield b"".join(pieces)
        answer.result()
    finally:
        gone = True


def next_of(tokens: Iterator[Token]) -> Iterator[Token]:
    """Yield at most the next token."""
    for token in tokens:
        yield token
        return


def _events(request: Request, tokens: Iterator[Token], trace: Trace, codec: own.Codec) -> Generator[bytes, None, None]:
    """Yield the server-sent events of an answer; an engine that fails on the way ends it with an error event."""
    count = 0
    try:
        for token in tokens:
            event = own.chunk(request.id, {"content": token.text})
            event["choices"][0]["token"] = token.id
            yield b"data: " + codec.dumps(event) + b"\n\n"
            count += 1
    except S2AError as error:
        yield b"data: " + codec.dumps({"error": {"message": str(error), "type": type(error).__name__}}) + b"\n\n"
        return
    finish = own.chunk(request.id, {}, _finish_reason(request, count))
    yield b"data: " + codec.dumps(finish) + b"\n\n"
    remote = own.remote_json(trace.to_remote())
    last = own.chunk(request.id, {}, usage=_usage(trace, count), s2a=remote)
    yield b"data: " + codec.dumps(last) + b"\n\ndata: [DONE]\n\n"


def _finish_reason(request: Request, count: int) -> str:
    return "length" if count >= request.max_tokens else "stop"


def _usage(trace: Trace, count: int) -> dict[str, int]:
    prompt = int(trace.facts.get("prompt_n", 0))
    return {"prompt_tokens": prompt, "completion_tokens": count, "total_tokens": prompt + count}


def _error(status: int, message: str) -> Response:
    """Answer an error in OpenAI's form."""
    return JSONResponse({"error": {"message": message, "type": "invalid_request_error", "code": status}}, status)


class HttpServer:
    """uvicorn on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` (127.0.0.1 and any port without it); raises PortInUse."""
        host, _, port = (wiring.address or "127.0.0.1:0").rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host or "127.0.0.1", int(port)))
            self._socket.listen()  # only now is the port ours
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise PortInUse(f"`port`: {port} is in use on {host}; choose another, or 0 for any free one") from error
            raise PortInUse(f"`port`: cannot bind {host}:{port}: {error.strerror}") from error
        self.address = "http://{}:{}".format(*self._socket.getsockname())
        config = uvicorn.Config(
            _received(application(handler)),
            loop="uvloop",
            http="httptools",
            log_level="warning",
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
            timeout_keep_alive=KEEP_ALIVE_S,
        )
        self._server = uvicorn.Server(config)

    def describe(self) -> dict[str, str | int]:
        """Say what serves."""
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "httptools"}

    def serve(self) -> None:
        """Serve until stopped."""
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Finish the requests under way, for a second at most."""
        self._server.should_exit = True
