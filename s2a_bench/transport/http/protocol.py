"""Bounds that uvicorn lacks: the number of connections, the length of a request, the time that it takes.

The headers decide on access; FastAPI gets the body when it is complete. A request beyond a bound is answered with one
line and its connection closed; the rest of its bytes is discarded meanwhile.
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
from s2a_bench.transport.connections import HANGUP, LINGER_S
from s2a_bench.transport.http import native
from s2a_bench.transport.http.native import Refused
from s2a_bench.transport.limits import check_values
from s2a_bench.transport.serving import Core


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
        self._timer: TimerHandle | None = None
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
