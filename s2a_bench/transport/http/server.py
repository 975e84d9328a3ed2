"""*As deployed*: FastAPI on uvicorn, like llama-cpp-python's server and most robot code.

It has a pydantic body, the standard library's JSON and Base64, and computes answers on a thread pool. `protocol` adds
the missing bounds.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from typing import Annotated, Any, Literal

import anyio  # FastAPI's own
import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, Field, StrictInt

from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import WebServer
from s2a_bench.transport.connections import LINGER_S
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import ChatExchange, of_fields
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.http.protocol import Protocol
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import Core, Disconnected
from s2a_bench.types import Request


class ImageUrl(BaseModel):
    url: str


class MessagePart(BaseModel):
    type: Literal["text", "image_url"]
    text: str = ""
    image_url: ImageUrl | None = None


class Message(BaseModel):
    role: str
    content: str | Annotated[list[MessagePart], Field(fail_fast=True)]


class ChatRequest(BaseModel):
    """The supported fields of ``POST /v1/chat/completions``."""

    messages: Annotated[list[Message], Field(fail_fast=True)]
    stream: bool = False
    max_tokens: StrictInt | None = None
    grammar: str = ""
    seed: StrictInt | None = None
    request_id: str = "chatcmpl-0"
    state: Annotated[list[float], Field(fail_fast=True)] | None = None


class DeployedExchange(ChatExchange):
    """A request with its body; its thread passes ASGI messages to the event loop in `messages`."""

    def __init__(self, body: ChatRequest, protocol: Protocol, limits: Limits) -> None:
        super().__init__(native.STANDARD, protocol.trace)
        self.held = protocol.held.pop_all()
        self.given_up = False
        self.messages: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self._body, self._limits = body, limits
        self._disconnected, self._loop = protocol.disconnected, asyncio.get_running_loop()

    def disconnected(self) -> bool:
        return self.given_up or self._disconnected()

    def read(self) -> tuple[Request, bool]:
        self.trace.mark("json_parse")
        return of_fields(self._body.model_dump(), self.trace, self._limits, native.STANDARD)

    def write(self, data: bytes, kind: str, *, last: bool) -> None:
        if kind:
            headers = [(b"content-type", kind.encode())]
            self._put({"type": "http.response.start", "status": 200, "headers": headers})
        self._put({"type": "http.response.body", "body": data, "more_body": not last})

    def whole(self, status: int, value: Any, headers: dict[str, str]) -> None:
        response = JSONResponse(value, status, headers)
        self._put({"type": "http.response.start", "status": status, "headers": response.raw_headers})
        self._put({"type": "http.response.body", "body": response.body})

    def _put(self, message: dict[str, Any]) -> None:
        try:
            self._loop.call_soon_threadsafe(self.messages.put_nowait, message)
        except RuntimeError as error:  # the server has ended
            raise Disconnected from error


class ExchangeResponse(Response):
    """Sends an exchange's messages, for ``most_s`` at most."""

    def __init__(self, exchange: DeployedExchange, most_s: float) -> None:
        super().__init__()
        self._exchange, self._most_s = exchange, most_s

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ARG002
        try:
            with anyio.move_on_after(self._most_s):
                while (message := await self._exchange.messages.get()) is not None:
                    await send(message)
                return
            scope["state"]["protocol"].transport.abort()  # the client does not read
        finally:
            self._exchange.given_up = True


def application(core: Core, *, documented: bool = False) -> FastAPI:
    app = FastAPI(title="s2a-bench", openapi_url="/openapi.json" if documented else None)  # /docs and /redoc follow it
    threads = ThreadPoolExecutor(core.limits.waiting + 2, "http")  # one is answered, one refused, the others wait

    @app.exception_handler(RequestValidationError)
    async def invalid(_: HttpRequest, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        message = f"{'.'.join(str(step) for step in first['loc'])}: {first['msg']}"
        return JSONResponse(native.error_json(400, message), 400)

    @app.get(native.HEALTH)
    async def health() -> Response:
        status, body = native.health(core)
        return JSONResponse(body, status)

    @app.get(native.MODELS)
    async def models() -> dict[str, Any]:
        return native.models(core.queued)

    @app.post(native.PATHS[native.AS_DEPLOYED])
    async def as_deployed(body: ChatRequest, request: HttpRequest) -> Response:
        exchange = DeployedExchange(body, request.scope["state"]["protocol"], core.limits)
        answering = asyncio.get_running_loop().run_in_executor(threads, core.answer, exchange)
        answering.add_done_callback(lambda _: exchange.messages.put_nowait(None))
        return ExchangeResponse(exchange, core.limits.answer_s + LINGER_S)

    return app


class _Server(uvicorn.Server):
    """uvicorn without its signal handlers: the process of the server has some."""

    def capture_signals(self) -> AbstractContextManager[None]:  # type: ignore[override]
        return nullcontext()


class HttpServer(WebServer):
    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        super().__init__(wiring, handler, "http", native.SCHEME)
        app = application(self._core, documented=wiring.options.api_docs)

        async def ending(scope: Any, receive: Any, send: Any) -> None:
            with suppress(asyncio.CancelledError):  # uvicorn's, when it stops
                await app(scope, receive, send)

        config = uvicorn.Config(
            ending,
            loop="uvloop",
            http=partial(Protocol, self._core, self._access),  # type: ignore[arg-type]
            ws="none",
            log_level="warning",
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
            timeout_keep_alive=native.KEEP_ALIVE_S,
        )
        self._server = _Server(config)

    def describe(self) -> dict[str, str | int]:
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "httptools"}

    def serve(self) -> None:
        self._server.run(sockets=[self._listener])

    def stop(self) -> None:
        self._server.should_exit = True
