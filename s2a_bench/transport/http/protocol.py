"""What uvicorn does not bound: how many connections there are, how long a request is, and how long it takes.

Its headers decide whether a request is let in; FastAPI is given its body when that is whole. A request beyond a bound
is told so in one line and its connection closed; what it still sends is thrown away meanwhile.
"""

from __future__ import annotations

import select
from asyncio import TimerHandle
from contextlib import ExitStack
from typing import Any

import httptools
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from s2a_bench.errors import S2AError, TooLarge
from s2a_bench.trace import Trace
from s2a_bench.transport.access import Access
from s2a_bench.transport.connections import GONE, LINGER_S
from s2a_bench.transport.http import native
from s2a_bench.transport.http.native import Refused
from s2a_bench.transport.limits import check_values
from s2a_bench.transport.serving import Core


class Protocol(HttpToolsProtocol):
    """One connection. What its callbacks raise ends its parser."""

    def __init__(self, core: Core, access: Access, **uvicorns: Any) -> None:
        super().__init__(**uvicorns)
        self.trace = Trace()
        """Begins with the last byte of the request."""
        self.held = ExitStack()
        """The bytes under way of the request, until what answers it takes them over."""
        self._core, self._access, self._limits = core, access, core.limits
        self._refused = False
        self._timer: TimerHandle | None = None
        self._beside = 0  # bytes since a head or body last went on: of a head, of trailers
        self._moved = False
        self._lost = False
        self._poll = select.poll()

    def connection_made(self, transport: Any) -> None:
        """Refuse one connection too many."""
        super().connection_made(transport)
        self._poll.register(transport.get_extra_info("socket"), select.POLLRDHUP)
        if len(self.connections) > self._limits.connections:
            most = f"{self._limits.connections} connections are open already"
            self._refuse(Refused(503, most, {"retry-after": "1"}))

    def disconnected(self) -> bool:
        """Whether the client has hung up, noticed while bytes of it lie unread, too; from any thread."""
        return self._lost or any(events & GONE for _, events in self._poll.poll(0))

    def data_received(self, data: bytes) -> None:
        """Parse, unless the connection is closing; a head may come a byte at a time, or be one header without end."""
        if self._refused:
            return
        self._unset_keepalive_if_required()
        self._moved = False
        try:
            self.parser.feed_data(data)
            self._beside = 0 if self._moved else self._beside + len(data)
            if self._beside > self._limits.header_bytes:
                raise self._too_long()
        except Refused as refused:
            self._refuse(refused)
        except httptools.HttpParserError as error:
            why = error.__context__  # what a callback raised
            why = Refused.because(why) if isinstance(why, S2AError) else why
            self._refuse(why if isinstance(why, Refused) else Refused(400, "Invalid HTTP request received."))

    def on_message_begin(self) -> None:
        """Start the time of a head; a request that comes before the last one is answered is not."""
        if self.cycle is not None and not self.cycle.response_complete:
            raise Refused(400, "one request after the other")
        self._moved = True
        self._wait(self._limits.head_s, "headers")
        super().on_message_begin()
        self.scope["state"]["protocol"] = self

    def on_header(self, name: bytes, value: bytes) -> None:
        super().on_header(name, value)
        if len(self.headers) > native.LINES:
            raise Refused(431, f"more than {native.LINES} lines of headers")

    def on_headers_complete(self) -> None:
        """Refuse what uvicorn would take, before there is a body; start the time of one."""
        head_bytes = sum(len(name) + len(value) for name, value in self.headers)
        if head_bytes + len(self.url) > self._limits.header_bytes:
            raise self._too_long()
        if self.parser.should_upgrade():
            raise Refused(400, "no connection of this server is upgraded")
        headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in self.headers]
        native.admit(self._access, self.url.partition(b"?")[0].decode("latin-1"), headers)
        self._check_size(int(dict(headers).get("content-length", 0)))
        self._came = self.held.enter_context(self._core.in_flight.counted())
        self._came(head_bytes)
        self._wait(self._limits.body_s, "body")
        super().on_headers_complete()
        self.cycle.body = bytearray()  # older uvicorns copy what has come at every piece

    def on_body(self, body: bytes) -> None:
        """Keep what has come of a body, unless it is answered already: the application waits for the whole."""
        self._moved = True
        if not self.cycle.response_complete:
            self._came(len(body))
            self.cycle.body += body
            self._check_size(len(self.cycle.body))

    def on_message_complete(self) -> None:
        """Let the application have a body that is no document of too many values."""
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
        """Drop what has come of a request, and count it no longer once the application, too, has let it go."""
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
        """Refuse the request unless the next part of it is whole by then."""
        self._stop_timer()
        self._timer = self.loop.call_later(seconds, self._late, f"the {what} took more than {seconds:g} s")

    def _late(self, message: str) -> None:
        self._refuse(Refused(408, message))

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _refuse(self, refused: Refused) -> None:
        """Answer, and close; where an answer is under way it is the last, and what follows is thrown away."""
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
