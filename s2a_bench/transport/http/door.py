"""What uvicorn lets in: limits on sizes, on time and on all connections together, kept before the application runs.

A request beyond a limit is answered here and its connection closed; what it still sends is thrown away meanwhile.
A request for the lane never reaches the application: its body is read straight into its place, and once it is there a
call answers it. What comes on its connection meanwhile waits, or, if it came with the body, is not answered.
"""

from __future__ import annotations

import json
from asyncio import BaseProtocol, BufferedProtocol, TimerHandle
from collections import deque
from http import HTTPStatus
from typing import Any

import numpy as np
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from s2a_bench.machine.tuning import give_back_memory
from s2a_bench.transport.http import own
from s2a_bench.transport.http.lane import Call, Lane, Reads
from s2a_bench.transport.limits import LIMITS, Limits

EARLY_BYTES = 1 << 16
"""The most that waits for the end of an answer."""

CYCLES_BYTES = 1 << 25
"""A body from here on: errors of frameworks hold the body, and their own frames."""

LINGER_S = 1.0
"""Time for a client to read a refusal; closing at once would reset the connection under it."""


class Door(HttpToolsProtocol):
    """One connection. Subclass it with `door` to share ``held_bytes`` among those of a server."""

    limits: Limits = LIMITS
    held: dict[str, int]
    lane: Lane

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Start with no request."""
        super().__init__(*args, **kwargs)
        self._refused = self._in_head = False
        self._head_bytes = self._body_bytes = 0
        self._unanswered: deque[int] = deque()
        self._timer: TimerHandle | None = None
        self._reads: Reads | None = None  # of the lane's request whose body is coming
        self._pieces: list[bytes] = []
        self._call: Call | None = None
        self._early = b""
        self._last = False

    def connection_made(self, transport: Any) -> None:
        """Refuse one connection too many."""
        super().connection_made(transport)
        if len(self.connections) > self.limits.connections:
            self._refuse(503, f"{self.limits.connections} connections are open already")

    def data_received(self, data: bytes) -> None:
        """Parse, unless the connection is closing."""
        if self._refused or self._last:
            return
        if self._call is not None:
            self._early += data
            if len(self._early) > EARLY_BYTES:
                self.flow.pause_reading()
            return
        self._head_bytes += len(data)
        super().data_received(data)
        if self._reads is not None and not self._refused and (size := self._said()):
            _Body(self, size, b"".join(self._pieces))
        if self._in_head and self._head_bytes > self.limits.header_bytes + len(data):
            self._refuse(431, f"more than {self.limits.header_bytes} bytes of headers")

    def on_message_begin(self) -> None:
        """Start to count the headers and their time."""
        if self._call is not None:
            self._last = True
            return
        self._in_head, self._head_bytes = True, 0
        self._time(self.limits.head_s, "the headers")
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Refuse headers that are too long, and a body that says that it will be."""
        if self._refused or self._last:
            return
        self._in_head, self._body_bytes = False, 0
        length = sum(len(name) + len(value) for name, value in self.headers) + len(self.url)
        if length > self.limits.header_bytes:
            self._refuse(431, f"more than {self.limits.header_bytes} bytes of headers")
            return
        self._unanswered.append(0)
        self._time(self.limits.body_s, "the body")
        free = self.cycle is None or self.cycle.response_complete
        self._reads = self.lane.reads(self.parser.get_method(), self.url, self.headers) if free else None
        if self._reads is None:
            super().on_headers_complete()
        elif self.expect_100_continue:
            self.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")
        if self._said() > self.limits.body_bytes:
            self._refuse(413, f"the body is larger than {self.limits.body_bytes} bytes")

    def on_body(self, body: bytes) -> None:
        """Count what comes, however long it said it would be; what comes after the answer is thrown away."""
        if self._refused or self._last or not self._unanswered:
            return
        if not self.came(len(body)):
            return
        if self._reads is not None:
            self._pieces.append(body)
        else:
            super().on_body(body)

    def came(self, size: int) -> bool:
        """Count bytes of a body; return whether they are taken."""
        self._body_bytes += size
        self._unanswered[-1] += size
        self.held["bytes"] += size
        if self._body_bytes > self.limits.body_bytes:
            self._refuse(413, f"the body is larger than {self.limits.body_bytes} bytes")
        elif self.held["bytes"] > self.limits.in_flight_bytes:
            self._refuse(503, f"requests of {self.limits.in_flight_bytes} bytes are under way already")
        return not self._refused

    def on_message_complete(self) -> None:
        """Stop the clock."""
        if self._last:
            return
        self._stop_timer()
        if self._refused:
            return
        if self._reads is not None:
            self.whole(b"".join(self._pieces))
        else:
            super().on_message_complete()

    def whole(self, body: bytes | memoryview) -> None:
        """Have the lane's request answered."""
        assert self._reads  # noqa: S101 - for mypy
        self._stop_timer()
        reads, self._reads, self._pieces = self._reads, None, []
        self._unset_keepalive_if_required()
        self._call = Call(self.lane, self.loop, self.transport, self._answered)
        keep = self.parser.should_keep_alive()
        self._call.start(reads, self.headers, body, chunks=self.parser.get_http_version() != "1.0", keep=keep)

    def _answered(self, keep: bool) -> None:
        """Take the next request."""
        self._call = None
        if self.transport.is_closing():
            return
        if self._last or not keep:
            self.transport.close()
            return
        self.parser = type(self.parser)(self)
        early, self._early = self._early, b""
        self.on_response_complete()
        self.flow.resume_reading()
        if early:
            self.data_received(early)

    def shutdown(self) -> None:
        """Close after the answer under way."""
        if self._call is not None:
            self._last = True
        else:
            super().shutdown()

    def on_response_complete(self) -> None:
        """Give back what the request held."""
        if self._unanswered:
            self._give_back(self._unanswered.popleft())
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give back what all requests held."""
        self._stop_timer()
        self._reads = None
        if self._call is not None:
            self._call.leave()
        self._give_back(sum(self._unanswered))
        self._unanswered.clear()
        super().connection_lost(exc)

    def _give_back(self, size: int) -> None:
        """Count bytes no more; what the application leaves of many in cycles goes, not only when Python looks."""
        self.held["bytes"] -= size
        if size >= CYCLES_BYTES:
            self.loop.call_later(LINGER_S, give_back_memory)

    def _said(self) -> int:
        """Return how long the body says that it will be."""
        return int(next((value for name, value in self.headers if name == b"content-length"), b"0"))

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
        self._refused, self._reads = True, None
        self._stop_timer()
        cycle = self.cycle
        answered = cycle is not None and cycle.response_started
        if cycle is not None and not cycle.response_complete:
            cycle.disconnected = True  # the application hears that the client has gone
            cycle.body = bytearray()
            cycle.message_event.set()
        if not answered or cycle.response_complete:
            body = json.dumps(own.error_json(status, message)).encode()
            head = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", "content-type: application/json"]
            head += ["retry-after: 1"] * (status == HTTPStatus.SERVICE_UNAVAILABLE)
            head += [f"content-length: {len(body)}", "connection: close", "", ""]
            self.transport.write("\r\n".join(head).encode() + body)
        self.flow.resume_reading()
        self.loop.call_later(LINGER_S, self.transport.close)


class _Body(BufferedProtocol):
    """What is left of a body, read into its place; only what came is ever touched of its memory."""

    def __init__(self, its_door: Door, size: int, begun: bytes) -> None:
        """Stand in for the door until the body is there."""
        self._door, self._have = its_door, len(begun)
        self._body = np.empty(size, np.uint8).data
        self._body[: len(begun)] = begun
        self._hand_over(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        del sizehint
        return self._body[self._have :]

    def buffer_updated(self, nbytes: int) -> None:
        self._have += nbytes
        taken = self._door.came(nbytes)
        if not taken or self._have == len(self._body):
            self._hand_over(self._door)
            if taken:
                self._door.whole(self._body)

    def eof_received(self) -> None:
        self._door.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        self._door.connection_lost(exc)

    def _hand_over(self, to: BaseProtocol) -> None:
        transport = self._door.transport
        transport.pause_reading()  # how it reads is settled when it begins to
        transport.set_protocol(to)
        transport.resume_reading()


def door(its_limits: Limits, its_lane: Lane) -> type[Door]:
    """Return the protocol of one server."""

    class Its(Door):
        limits, lane = its_limits, its_lane
        held = {"bytes": 0}  # noqa: RUF012 - shared by all connections of a server

    return Its
