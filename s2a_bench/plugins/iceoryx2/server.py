"""The server: pixels are read where the client wrote them, and pieces of the answer go into slices at once."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from threading import Event
from time import sleep
from traceback import clear_frames
from typing import Any, Final

import iceoryx2
import orjson

from s2a_bench.errors import PortInUse, S2AError, TooLarge, TransportError
from s2a_bench.plugins.iceoryx2 import Iceoryx2Options
from s2a_bench.plugins.iceoryx2.wire import (
    ACTIVE,
    CLIENTS,
    ERRORS,
    HEAD,
    PAUSE_S,
    POLL_S,
    SLICE,
    SLICE_BYTES,
    UNREAD,
    Domain,
    bytes_in,
    listens,
    packed,
    room_for,
    wait,
)
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.limits import Limits, read_request
from s2a_bench.transport.pictures import decoded
from s2a_bench.transport.serving import Core, Disconnected, Exchange, SharedSourceWorkers
from s2a_bench.types import Piece, Request
from s2a_bench.vectors import state_of

ALIGNED: Final = iceoryx2.Alignment.new(8)
"""Counters in a slice are read and written whole."""


class Iceoryx2Server:
    def __init__(self, wiring: Wiring[Iceoryx2Options], handler: Handler) -> None:
        """Offer the service; raises PortInUse, TransportError."""
        self.core = Core(handler, wiring.limits)
        self.address = wiring.address or f"s2a-{secrets.token_hex(6)}"
        self.stopped = Event()
        self._events: dict[int, tuple[Any, Any]] = {}
        self._domain = Domain()
        try:
            self._requests, self._listener = self._offer(wiring.limits)
        except ERRORS as error:
            clear_frames(error.__traceback__)  # they hold what was made
            self._domain.leave()
            if "ExceedsMaxSupported" in str(error):
                raise PortInUse(f"`service`: another server has the name {self.address}") from error
            raise TransportError(f"`service`: iceoryx2 cannot offer {self.address}: {error}") from error

    def _offer(self, limits: Limits) -> tuple[Any, Any]:
        """Return the source of requests, and the listener that they wake; raises an error of iceoryx2."""
        clients = min(CLIENTS, limits.connections)
        service = self._domain.requests(self.address).max_servers(1).max_clients(clients).max_nodes(clients + 1)
        # Overflow that is "safe" loses silently: an unread answer is replaced by a newer one.
        service = service.enable_safe_overflow_for_requests(False).enable_safe_overflow_for_responses(False)
        service = service.max_active_requests_per_client(ACTIVE).max_loaned_requests(1)
        service = service.max_response_buffer_size(2 * UNREAD)
        service = service.max_borrowed_responses_per_pending_response(2).request_payload_alignment(ALIGNED)
        builder = service.open_or_create().server_builder().initial_max_slice_len(SLICE_BYTES)
        requests = builder.backpressure_strategy(iceoryx2.BackpressureStrategy.DiscardData).create()
        event = self._domain.event(self.address).max_listeners(1).max_notifiers(clients).max_nodes(clients + 1)
        return requests, event.open_or_create().listener_builder().create()

    def describe(self) -> dict[str, str | int]:
        return {"server": "iceoryx2, request-response", "version": version("iceoryx2")}

    def serve(self) -> None:
        workers = SharedSourceWorkers(self._take, self.stopped)
        workers.start()
        self.stopped.wait()
        workers.join()
        self._leave()

    def stop(self) -> None:
        self.stopped.set()

    def _leave(self) -> None:
        self._events.clear()
        self._listener = self._requests = None
        self._domain.leave()

    def _take(self) -> Callable[[], object] | None:
        """Wait for a request; return what answers it. What is raised by one that cannot be read drops it."""
        try:
            active = self._requests.receive()
            if active is None:
                wait(self._listener, POLL_S)
                active = self._requests.receive()
        except ERRORS:
            self.stopped.wait(POLL_S)  # until earlier requests have been answered, say
            raise
        if active is None:
            self._forget()
            return None
        trace = Trace()
        trace.mark("network")
        return partial(self.core.answer, Iceoryx2Exchange(self, active, trace))

    def event(self, client: int) -> tuple[Any, Any]:
        """Return the event that wakes a client, and its notifier; raises an error of iceoryx2 if it has ended."""
        if client not in self._events:
            self._forget()
            room_for(2 * UNREAD * SLICE_BYTES)
            event = self._domain.event(self.address, client).open()
            self._events[client] = event, event.notifier_builder().create()
        return self._events[client]

    def _forget(self) -> None:
        """Let go of clients that have left or were killed."""
        self._domain.clean()
        for client, (event, _) in [*self._events.items()]:
            if not listens(event):
                self._events.pop(client, None)


class Iceoryx2Exchange(Exchange):
    parse_stage = "header_parse"

    def __init__(self, server: Iceoryx2Server, active: Any, trace: Trace) -> None:
        super().__init__(trace)
        self._server, self._active = server, active
        self._data = bytes_in(active)
        _, client, self._number, self._length = HEAD.unpack_from(self._data)
        self._read = self._data[:8].cast("Q")
        self._sent = 0
        self._event, self._notifier = server.event(client)
        self._unsent = bytearray()

    def request(self) -> Request:
        limits, data = self._server.core.limits, self._data[HEAD.size :]
        if len(data) > limits.body_bytes:
            raise TooLarge(f"the request is larger than {limits.body_bytes} bytes")
        self.held.enter_context(self._server.core.in_flight.counted())(len(data))
        fields = orjson.loads(data[: self._length])
        self.trace.mark("header_parse")
        images, begin, pixels = [], self._length, limits.pixels
        for picture in fields["images"]:
            images.append(decoded(picture["type"], data[begin : begin + picture["bytes"]], self.trace, pixels))
            pixels -= images[-1].pixel_count
            begin += picture["bytes"]
        return read_request(fields, limits, fields["id"], fields["prompt"], tuple(images), state_of(fields["state"]))

    def send(self, piece: Piece) -> bool:
        self._unsent += packed(piece)
        self._flush()
        return True

    def end(self) -> None:
        self._last(packed(self.trace.to_remote()))

    def fail(self, error: S2AError) -> None:
        self._last(packed(str(error)))

    def disconnected(self) -> bool:
        """Whether the client gave the request up or has left, so that another may have its place in iceoryx2."""
        return self._server.stopped.is_set() or not (self._active.is_connected and listens(self._event))

    def _last(self, piece: bytes) -> None:
        """Send the last piece, and wait for a client that is slow to read."""
        self._unsent += piece
        try:
            while self._flush():
                if not self.left_s():
                    raise Disconnected("the client does not read its answer")
                sleep(PAUSE_S)
        finally:
            self._active = None  # iceoryx2 lends a client's requests by number, and a logged error would hold this one

    def _flush(self) -> bool:
        """Send as much as the client has room for; return whether anything is left. Raises Disconnected."""
        if self.disconnected():
            raise Disconnected
        unsent = self._unsent
        try:
            while unsent and self._sent - self._read[0] < UNREAD:
                size = min(len(unsent), SLICE_BYTES - SLICE.size)
                lent = self._active.loan_slice_uninit(SLICE.size + size)
                view = bytes_in(lent)
                SLICE.pack_into(view, 0, self._number, self._sent)
                view[SLICE.size :] = unsent[:size]
                del unsent[:size]
                lent.assume_init().send()
                self._sent += 1
                self._notifier.notify()
        except ERRORS as error:
            raise Disconnected from error
        return bool(unsent)
