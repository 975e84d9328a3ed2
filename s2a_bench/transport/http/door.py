"""What uvicorn lets in: limits on sizes, on time and on all connections together, kept before the application runs.

A request beyond a limit is answered here and its connection closed; what it still sends is thrown away meanwhile.
"""

from __future__ import annotations

import json
from asyncio import TimerHandle
from collections import deque
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from s2a_bench.transport.limits import LIMITS, Limits

LINGER_S = 1.0
"""Time for a client to read a refusal; closing at once would reset the connection under it."""


class Door(HttpToolsProtocol):
    """One connection. Subclass it with `door` to share ``held_bytes`` among those of a server."""

    limits: Limits = LIMITS
    held: dict[str, int]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Start with no request."""
        super().__init__(*args, **kwargs)
        self._refused = self._in_head = False
        self._head_bytes = self._body_bytes = 0
        self._unanswered: deque[int] = deque()
        self._timer: TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Refuse one connection too many."""
        super().connection_made(transport)
        if len(self.connections) > self.limits.connections:
            self._refuse(503, f"{self.limits.connections} connections are open already")

    def data_received(self, data: bytes) -> None:
        """Parse, unless the connection is closing."""
        if self._refused:
            return
        self._head_bytes += len(data)
        super().data_received(data)
        if self._in_head and self._head_bytes > self.limits.header_bytes + len(data):
            self._refuse(431, f"more than {self.limits.header_bytes} bytes of headers")

    def on_message_begin(self) -> None:
        """Start to count the headers and their time."""
        self._in_head, self._head_bytes = True, 0
        self._time(self.limits.head_s, "the headers")
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Refuse headers that are too long, and a body that says that it will be."""
        self._in_head, self._body_bytes = False, 0
        if self._refused:
            return
        length = sum(len(name) + len(value) for name, value in self.headers) + len(self.url)
        if length > self.limits.header_bytes:
            self._refuse(431, f"more than {self.limits.header_bytes} bytes of headers")
            return
        self._unanswered.append(0)
        self._time(self.limits.body_s, "the body")
        super().on_headers_complete()
        said = next((value for name, value in self.headers if name == b"content-length"), b"0")
        if int(said) > self.limits.body_bytes:
            self._refuse(413, f"the body is larger than {self.limits.body_bytes} bytes")

    def on_body(self, body: bytes) -> None:
        """Count what comes, however long it said it would be; what comes after the answer is thrown away."""
        if self._refused or not self._unanswered:
            return
        self._body_bytes += len(body)
        self._unanswered[-1] += len(body)
        self.held["bytes"] += len(body)
        if self._body_bytes > self.limits.body_bytes:
            self._refuse(413, f"the body is larger than {self.limits.body_bytes} bytes")
        elif self.held["bytes"] > self.limits.in_flight_bytes:
            self._refuse(503, f"requests of {self.limits.in_flight_bytes} bytes are under way already")
        else:
            super().on_body(body)

    def on_message_complete(self) -> None:
        """Stop the clock."""
        self._stop_timer()
        if not self._refused:
            super().on_message_complete()

    def on_response_complete(self) -> None:
        """Give back what the request held."""
        if self._unanswered:
            self.held["bytes"] -= self._unanswered.popleft()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give back what all requests held."""
        self._stop_timer()
        self.held["bytes"] -= sum(self._unanswered)
        self._unanswered.clear()
        super().connection_lost(exc)

    def _time(self, seconds: float, what: str) -> None:
        self._stop_timer()
        self._timer = self.loop.call_later(seconds, self._refuse, 408, f"{what} took more than {seconds:g} s")

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _refuse(self, status: int, message: str) -> None:
        """Answer, if nothing was answered yet, and close."""
        if self._refused:
            return
        self._refused = True
        self._stop_timer()
        cycle = self.cycle
        answered = cycle is not None and cycle.response_started
        if cycle is not None and not cycle.response_complete:
            cycle.disconnected = True  # the application hears that the client has gone
            cycle.body = bytearray()
            cycle.message_event.set()
        if not answered or cycle.response_complete:
            error = {"message": message, "type": "invalid_request_error", "code": status}
            body = json.dumps({"error": error}).encode()
            head = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", "content-type: application/json"]
            head += ["retry-after: 1"] * (status == HTTPStatus.SERVICE_UNAVAILABLE)
            head += [f"content-length: {len(body)}", "connection: close", "", ""]
            self.transport.write("\r\n".join(head).encode() + body)
        self.flow.resume_reading()
        self.loop.call_later(LINGER_S, self.transport.close)


def door(its_limits: Limits) -> type[Door]:
    """Return the protocol of one server."""

    class Its(Door):
        limits = its_limits
        held = {"bytes": 0}  # noqa: RUF012 - shared by all connections of a server

    return Its
