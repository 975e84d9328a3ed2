"""The HTTP server on uvicorn: FastAPI for *as deployed*, a lane beside it for the other variants, one handler.

*As deployed* is written as llama-cpp-python's own server and most robot code are: a pydantic body, the standard
library's Base64, a synchronous endpoint in the thread pool, which pulls the first token before it answers so that an
error still gets its status code. *Best effort* and *binary* never reach the application: see `lane`.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, StrictInt
from starlette.requests import ClientDisconnect

from s2a_bench.errors import Busy, S2AError
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.http import own
from s2a_bench.transport.http.access import keyed
from s2a_bench.transport.http.answer import Answer
from s2a_bench.transport.http.door import door
from s2a_bench.transport.http.lane import Lane
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.http.reading import of_fields
from s2a_bench.transport.http.reply import Reply
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.listening import bound_socket
from s2a_bench.transport.turns import STUCK_S, Queued

KEEP_ALIVE_S = 3600
"""A client that waits for its turn in an interleaved run keeps its connection."""

CLOSING_S = 0.01
"""Time for the loop to close what is broken off."""


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
    state: list[float] | None = None


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
    """Build the application: chat completions as deployed, and what tools expect beside them."""
    app = FastAPI(title="s2a-bench", openapi_url="/openapi.json" if documented else None)  # /docs and /redoc follow it

    @app.exception_handler(S2AError)
    async def refuse(_: HttpRequest, error: S2AError) -> Response:
        headers = {"Retry-After": f"{error.retry_after_s:.0f}"} if isinstance(error, Busy) else None
        status = own.status_of(error)
        return JSONResponse(own.error_json(status, str(error)), status, headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: HttpRequest, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        message = f"{'.'.join(str(step) for step in first['loc'])}: {first['msg']}"
        return JSONResponse(own.error_json(400, message), 400)

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
        trace: Trace = http_request.state.trace
        trace.mark("json_parse")
        request, stream = of_fields(body.model_dump(), trace, limits, own.STANDARD)
        reply = Reply(queued, request, trace, own.STANDARD, stream=stream)
        answer = http_request.state.answer = Answer(reply)
        answer.begin()
        return answer

    return app


class _Server(uvicorn.Server):
    """uvicorn without its signal handlers: whoever runs the server has some."""

    def __init__(self, config: uvicorn.Config, lane: Lane) -> None:
        super().__init__(config)
        self._lane = lane

    def capture_signals(self) -> AbstractContextManager[None]:  # type: ignore[override]
        return nullcontext()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what is under way, of the lane too, which uvicorn does not know."""
        await super().shutdown(sockets)
        self._lane.close()
        await asyncio.sleep(CLOSING_S)


class HttpServer:
    """uvicorn on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was, without it 127.0.0.1 and any port.

        Raises PortInUse, and UsageError where others than this machine would need no key and nobody said so.
        """
        self._socket, key = bound_socket(wiring.address, "http", wiring.options)
        self.address = "http://{}:{}".format(*self._socket.getsockname())
        queued = Queued.around(handler, wiring.limits)
        app = application(queued, wiring.limits, documented=wiring.options.api_docs)
        lane = Lane(queued, wiring.limits, key)
        config = uvicorn.Config(
            keyed(_received(app), key),
            loop="uvloop",
            http=door(wiring.limits, lane),
            log_level="warning",
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
            timeout_keep_alive=KEEP_ALIVE_S,
        )
        self._server = _Server(config, lane)

    def describe(self) -> dict[str, str | int]:
        """Say what serves."""
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "httptools"}

    def serve(self) -> None:
        """Serve until stopped."""
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Finish the requests under way, for a second at most."""
        self._server.should_exit = True
