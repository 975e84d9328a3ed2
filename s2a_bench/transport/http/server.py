"""*As deployed*: FastAPI on uvicorn with h11, like llama-cpp-python's server and most robot code.

It has a pydantic body, the standard library's JSON and Base64, and computes answers on a thread pool.

uvicorn refuses requests beyond a number of connections, and a head that has grown too long. `Admission` bounds the body
and its time, and lets the headers decide on access: FastAPI gets a request that is admitted and complete. The time of a
head, and of an answer that its client does not read, has no bound; idle connections end at the limit of open files.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Annotated, Any, Literal

import anyio  # FastAPI's own
import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, Field, StrictInt

from s2a_bench.errors import S2AError, TooLarge
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import Access, WebServer
from s2a_bench.transport.connections import LINGER_S
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import ChatExchange, of_fields
from s2a_bench.transport.http.native import Refused
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import Core, Disconnected
from s2a_bench.types import Request


class Arrival:
    """A request that is complete: its trace begins with its last byte, and it holds its bytes in flight."""

    def __init__(self, held: ExitStack) -> None:
        self.held, self.trace = held, Trace()
        self.trace.mark("network")


class Admission:
    """ASGI middleware that reads a request before the application, or answers it with one line and closes."""

    def __init__(self, app: Any, core: Core, access: Access) -> None:
        self._app, self._core, self._access = app, core, access

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        with ExitStack() as held, suppress(asyncio.CancelledError, Disconnected):  # uvicorn cancels when it stops
            try:
                whole = [await self._whole(scope, receive, held)]
            except (Refused, S2AError) as error:
                refused = error if isinstance(error, Refused) else Refused(*native.refusal_of(error))
                await _refuse(refused, receive, send)
                return

            async def replay() -> Any:  # after the body FastAPI waits for the client to disconnect
                return whole.pop() if whole else await receive()

            scope["state"]["arrival"] = Arrival(held)
            await self._app(scope, replay, send)

    async def _whole(self, scope: Any, receive: Any, held: ExitStack) -> dict[str, Any]:
        """Return the request as one message. Raises Refused, TooLarge, Busy, Disconnected."""
        limits, body = self._core.limits, bytearray()
        headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        native.admit(self._access, scope["path"], headers)
        _check_size(int(dict(headers).get("content-length", 0)), limits)
        count = held.enter_context(self._core.in_flight.counted())
        with anyio.move_on_after(limits.body_s):
            while (message := await receive())["type"] != "http.disconnect":
                piece = message.get("body", b"")
                count(len(piece))
                body += piece
                _check_size(len(body), limits)
                if not message.get("more_body"):
                    return {"type": "http.request", "body": bytes(body), "more_body": False}
            raise Disconnected
        raise Refused(408, f"the body took more than {limits.body_s:g} s")


def _check_size(body_bytes: int, limits: Limits) -> None:
    if body_bytes > limits.body_bytes:
        raise TooLarge(f"the body is larger than {limits.body_bytes} bytes")


async def _refuse(refused: Refused, receive: Any, send: Any) -> None:
    """Answer, discard what arrives within `LINGER_S`, so that the client reads the answer, and close."""
    headers = {**refused.headers, "connection": "close"}
    response = JSONResponse(native.error_json(refused.status, str(refused)), refused.status, headers)
    await send({"type": "http.response.start", "status": refused.status, "headers": response.raw_headers})
    await send({"type": "http.response.body", "body": response.body, "more_body": True})
    with anyio.move_on_after(LINGER_S):
        while (await receive()).get("more_body"):
            pass
    await send({"type": "http.response.body"})


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

    def __init__(self, body: ChatRequest, arrival: Arrival, limits: Limits) -> None:
        super().__init__(native.STANDARD, arrival.trace)
        self.held = arrival.held.pop_all()
        self.given_up = False
        self.messages: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self._body, self._limits, self._loop = body, limits, asyncio.get_running_loop()

    def disconnected(self) -> bool:
        return self.given_up

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
    """Sends an exchange's messages, for ``most_s`` at most, and gives it up when the client disconnects."""

    def __init__(self, exchange: DeployedExchange, most_s: float) -> None:
        super().__init__()
        self._exchange, self._most_s = exchange, most_s

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ARG002
        watching = asyncio.create_task(self._watch(receive))
        try:
            with anyio.move_on_after(self._most_s):
                while (message := await self._exchange.messages.get()) is not None:
                    await send(message)
        finally:
            self._exchange.given_up = True
            watching.cancel()

    async def _watch(self, receive: Any) -> None:
        while (await receive())["type"] != "http.disconnect":
            pass
        self._exchange.given_up = True


def application(core: Core, access: Access, *, documented: bool = False) -> Admission:
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
        exchange = DeployedExchange(body, request.state.arrival, core.limits)
        answering = asyncio.get_running_loop().run_in_executor(threads, core.answer, exchange)
        answering.add_done_callback(lambda _: exchange.messages.put_nowait(None))
        return ExchangeResponse(exchange, core.limits.answer_s + LINGER_S)

    return Admission(app, core, access)


class HttpServer(WebServer):
    def __init__(self, wiring: Wiring[HttpOptions], handler: Handler) -> None:
        super().__init__(wiring, handler, "http", native.SCHEME)
        config = uvicorn.Config(
            application(self._core, self._access, documented=wiring.options.api_docs),
            loop="uvloop",
            http="h11",
            ws="none",
            log_level="error",
            access_log=False,
            lifespan="off",
            limit_concurrency=wiring.limits.connections + 1,  # it refuses from this number on
            h11_max_incomplete_event_size=wiring.limits.header_bytes,
            timeout_graceful_shutdown=1,
            timeout_keep_alive=native.KEEP_ALIVE_S,
        )
        self._server = uvicorn.Server(config)

    def describe(self) -> dict[str, str | int]:
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "h11"}

    def serve(self) -> None:
        """Serve on another thread: on the main one uvicorn handles the signals, as the process of the server does."""
        with ThreadPoolExecutor(1, "uvicorn") as thread:
            thread.submit(self._server.run, [self._listener]).result()

    def stop(self) -> None:
        self._server.should_exit = True
