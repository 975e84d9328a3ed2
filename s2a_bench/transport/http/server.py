"""*As deployed*: FastAPI on uvicorn, like llama-cpp-python's server and most robot code.

It has a pydantic body, the standard library's JSON and Base64, and computes answers on a thread pool.

`Protocol` adds the bounds that uvicorn lacks: the number of connections, the length of a request, the time that it
takes. The headers decide on access; FastAPI gets the body when it is complete. A request beyond a bound is answered
with one line and its connection closed; the rest of its bytes is discarded meanwhile.
"""

from __future__ import annotations

import asyncio
import select
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext, suppress
from functools import partial
from typing import Annotated, Any, Literal

import anyio  # FastAPI's own
import httptools
import uvicorn
from fastapi import FastAPI
from fastapi import Request as HttpRequest
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, Field, StrictInt
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from s2a_bench.errors import S2AError, TooLarge
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.access import Access, WebServer
from s2a_bench.transport.connections import HANGUP, LINGER_S
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import ChatExchange, of_fields
from s2a_bench.transport.http.native import Refused
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.limits import Limits, check_values
from s2a_bench.transport.serving import Core, Disconnected
from s2a_bench.types import Request


class Protocol(HttpToolsProtocol):
    """One connection. An exception of a callback ends its parser."""

    def __init__(self, core: Core, access: Access, **uvicorns: Any) -> None:
        super().__init__(**uvicorns)
        self.trace = Trace()
        """Begins with the last byte of the request."""
        self.held = ExitStack()
        """The request's bytes in flight, until its exchange takes them over."""
        self._core, self._access, self._limits = core, access, core.limits
        self._refused = False
        self._timer: asyncio.TimerHandle | None = None
        self._idle_bytes = 0  # bytes since the last progress of a head or body
        self._progress = False
        self._lost = False
        self._poll = select.poll()

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._poll.register(transport.get_extra_info("socket"), select.POLLRDHUP)
        if len(self.connections) > self._limits.connections:
            most = f"{self._limits.connections} connections are open already"
            self._refuse(Refused(503, most, {"retry-after": "1"}))

    def disconnected(self) -> bool:
        """Whether the client has hung up, even if some of its bytes are unread; from any thread."""
        return self._lost or any(events & HANGUP for _, events in self._poll.poll(0))

    def data_received(self, data: bytes) -> None:
        """Parse, unless the connection is closing; a head may arrive byte by byte, or have a header without end."""
        if self._refused:
            return
        self._unset_keepalive_if_required()
        self._progress = False
        try:
            self.parser.feed_data(data)
            self._idle_bytes = 0 if self._progress else self._idle_bytes + len(data)
            if self._idle_bytes > self._limits.header_bytes:
                raise self._too_long()
        except Refused as refused:
            self._refuse(refused)
        except httptools.HttpParserError as error:
            why = error.__context__  # the exception of a callback
            why = Refused(*native.refusal_of(why)) if isinstance(why, S2AError) else why
            self._refuse(why if isinstance(why, Refused) else Refused(400, "Invalid HTTP request received."))

    def on_message_begin(self) -> None:
        """Start the time of a head; raises Refused for a request before the last answer is complete."""
        if self.cycle is not None and not self.cycle.response_complete:
            raise Refused(400, "one request after the other")
        self._progress = True
        self._wait(self._limits.head_s, "headers")
        super().on_message_begin()
        self.scope["state"]["protocol"] = self

    def on_header(self, name: bytes, value: bytes) -> None:
        super().on_header(name, value)
        if len(self.headers) > native.LINES:
            raise Refused(431, f"more than {native.LINES} lines of headers")

    def on_headers_complete(self) -> None:
        """Refuse before the body what uvicorn would accept; start the time of the body."""
        head_bytes = sum(len(name) + len(value) for name, value in self.headers)
        if head_bytes + len(self.url) > self._limits.header_bytes:
            raise self._too_long()
        if self.parser.should_upgrade():
            raise Refused(400, "no connection of this server is upgraded")
        headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in self.headers]
        native.admit(self._access, self.url.partition(b"?")[0].decode("latin-1"), headers)
        self._check_size(int(dict(headers).get("content-length", 0)))
        self._count = self.held.enter_context(self._core.in_flight.counted())
        self._count(head_bytes)
        self._wait(self._limits.body_s, "body")
        super().on_headers_complete()
        self.cycle.body = bytearray()  # older versions of uvicorn copy all bytes at every addition

    def on_body(self, body: bytes) -> None:
        """Collect the body, unless it is answered already: the application waits for the whole."""
        self._progress = True
        if not self.cycle.response_complete:
            self._count(len(body))
            self.cycle.body += body
            self._check_size(len(self.cycle.body))

    def on_message_complete(self) -> None:
        """Pass the body to the application unless it has too many values."""
        self._stop_timer()
        if not self.cycle.response_complete:
            self.trace = Trace()
            self.trace.mark("network")
            check_values(self.cycle.body)
        super().on_message_complete()

    def on_response_complete(self) -> None:
        self._let_go()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._lost = True
        self._stop_timer()
        self._let_go()
        super().connection_lost(exc)

    def _let_go(self) -> None:
        """Drop a request's body; its bytes stay in flight until the application has dropped it too."""
        if self.cycle is not None:
            self.cycle.body = bytearray()
        held, self.held = self.held, ExitStack()
        self.loop.call_soon(held.close)

    def _check_size(self, body_bytes: int) -> None:
        if body_bytes > self._limits.body_bytes:
            raise TooLarge(f"the body is larger than {self._limits.body_bytes} bytes")

    def _too_long(self) -> Refused:
        return Refused(431, f"more than {self._limits.header_bytes} bytes of headers")

    def _wait(self, seconds: float, what: str) -> None:
        """Refuse the request unless its head, or body, is complete after this time."""
        self._stop_timer()
        refused = Refused(408, f"the {what} took more than {seconds:g} s")
        self._timer = self.loop.call_later(seconds, self._refuse, refused)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _refuse(self, refused: Refused) -> None:
        """Answer and close; a running answer is the last, and further bytes are discarded."""
        self._refused = True
        self._stop_timer()
        cycle = self.cycle
        if cycle is not None and not cycle.response_complete:
            cycle.keep_alive = False
            if not cycle.more_body:
                return
            cycle.disconnected = True
            cycle.message_event.set()
        self._let_go()
        if cycle is None or cycle.response_complete or not cycle.response_started:
            self.transport.write(refused.answer)
        self.loop.call_later(LINGER_S, self.transport.close)


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
        self._server = uvicorn.Server(config)
        # the process of the server has signal handlers of its own
        self._server.capture_signals = nullcontext  # type: ignore[assignment, method-assign]

    def describe(self) -> dict[str, str | int]:
        return {"server": "uvicorn", "version": uvicorn.__version__, "loop": "uvloop", "http": "httptools"}

    def serve(self) -> None:
        self._server.run(sockets=[self._listener])

    def stop(self) -> None:
        self._server.should_exit = True
