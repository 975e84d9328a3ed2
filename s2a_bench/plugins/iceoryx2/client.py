"""The client: pictures are converted straight into the lent slice, and pieces read as they arrive."""

from __future__ import annotations

import secrets
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from traceback import clear_frames
from typing import Any, Final

import iceoryx2
import numpy as np
import orjson

from s2a_bench.clock import now_ns
from s2a_bench.errors import MessagesLost, RequestFailed, ServerDied, TransportError, UsageError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.plugins.iceoryx2 import Iceoryx2Options
from s2a_bench.plugins.iceoryx2.wire import (
    ACTIVE,
    ERRORS,
    HEAD,
    POLL_S,
    SLICE,
    AnswerPart,
    Domain,
    bytes_in,
    listens,
    room_for,
    unpacked,
    wait,
)
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.limits import MIB, Bounds
from s2a_bench.transport.pictures import bgr_of, encoded, raw_mime
from s2a_bench.types import Action, Frame, Piece, Request, Token

USED: Final = 4096
"""A new client takes fewer loans than this before its first request. iceoryx2 knows a request by its client's place and
the count of loans: with equal counts the server would end a new client's request with that of the one before it."""


class Iceoryx2Client(Client):
    def __init__(self, wiring: Wiring[Iceoryx2Options], alive: Callable[[], bool]) -> None:
        """Connect; raises ServerDied if no server has the service's name, TransportError."""
        self._wiring, self._alive, self._name = wiring, alive, wiring.address
        self._id, self._number, self._largest = secrets.randbits(64), secrets.randbits(63), 0
        self._domain: Domain | None = Domain()
        try:
            self._port, self._server, self._wake, self._listener = self._connect(self._domain)
        except ERRORS as error:
            clear_frames(error.__traceback__)  # they hold what was made
            self._domain.leave()
            if str(error) == "DoesNotExist":
                where = f"in {self._domain.folder} (XDG_RUNTIME_DIR)"
                raise ServerDied(f"no server has the iceoryx2 service {self._name} {where}") from error
            if "ExceedsMax" in str(error):
                raise RequestFailed(f"the server at {self._name} takes no further client") from error
            raise TransportError(f"iceoryx2 makes no client of the service {self._name}: {error}") from error

    def _connect(self, domain: Domain) -> tuple[Any, Any, Any, Any]:
        """Return the port of requests, the server's event, and what wakes either side; raises errors of iceoryx2."""
        event = domain.event(self._name, self._id).max_listeners(1).max_notifiers(4).max_nodes(2)
        listener = event.create().listener_builder().create()
        server = domain.event(self._name).open()
        wake = server.notifier_builder().create()
        builder = domain.requests(self._name).open().client_builder().initial_max_slice_len(MIB)
        # A request that finds the server's queue full is discarded instead of waiting, which `_answer` notices.
        builder = builder.backpressure_strategy(iceoryx2.BackpressureStrategy.DiscardData)
        port = builder.allocation_strategy(iceoryx2.AllocationStrategy.PowerOfTwo).create()
        for _ in range(secrets.randbelow(USED)):
            port.loan_slice_uninit(1).delete()
        return port, server, wake, listener

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        bounds = self._wiring.bounds(self._name, request.max_tokens)
        try:
            pending = self._send(request, trace)
        except ERRORS as error:
            raise self._failed(error) from error
        try:
            for part in self._answer(pending, bounds):
                if isinstance(part, (Token, Action)):
                    if not part.index:
                        trace.mark("return")
                    yield part
                elif isinstance(part, str):
                    raise RequestFailed(f"the server broke off: {part}")
                else:
                    trace.receive(part)
                    return
        finally:
            with suppress(*ERRORS):
                while pending.receive() is not None:  # or the next request in its place would find them
                    pass
            pending.delete()  # tells the server; an exception's traceback would keep it

    def close(self) -> None:
        """Leave. A request that waits on another thread keeps what it uses, and fails."""
        self._port = self._server = self._wake = self._listener = None
        if self._domain is not None:
            self._domain.leave()
        self._domain = None

    def _send(self, request: Request, trace: Trace) -> Any:
        """Write header and pictures into a slice and send it; return the pending answer. Raises errors of iceoryx2."""
        port = self._port
        if port is None:
            raise RequestFailed(f"the client of {self._name} is closed")
        pictures = [self._picture(frame, trace) for frame in request.images]
        fields = {
            "id": request.id,
            "prompt": request.prompt,
            "max_tokens": request.max_tokens,
            "grammar": request.grammar,
            "seed": request.seed,
            "state": request.state,
            "images": [facts for facts, _ in pictures],
        }
        header = orjson.dumps(fields)
        size = HEAD.size + len(header) + sum(facts["bytes"] for facts, _ in pictures)
        if size > self._largest:
            room_for((2 * ACTIVE + 1) * size)
            self._largest = size
        self._number += 1
        lent = port.loan_slice_uninit(size)
        try:
            data = bytes_in(lent)
            HEAD.pack_into(data, 0, 0, self._id, self._number, len(header))
            self._read = data[:8].cast("Q")
            begin = HEAD.size + len(header)
            data[HEAD.size : begin] = header
            trace.mark("header_pack")
            for facts, frame in pictures:
                place = np.frombuffer(data[begin : begin + facts["bytes"]], np.uint8)
                if self._wiring.options.payload == "raw":
                    bgr_of(frame, trace, place.reshape(frame.height, frame.width, 3))
                else:
                    place[:] = frame.data.reshape(-1)
                begin += facts["bytes"]
            trace.facts[PAYLOAD_BYTES] = size
            trace.mark("header_pack")
            return lent.assume_init().send()
        except BaseException:
            lent.delete()
            raise

    def _picture(self, frame: Frame, trace: Trace) -> tuple[dict[str, Any], Frame]:
        """Return media type and size of a picture, and what is written: pixels are converted where they are read."""
        payload = self._wiring.options.payload
        if payload == "raw":
            return {"type": raw_mime(frame, "bgr8"), "bytes": 3 * frame.pixel_count}, frame
        if payload == "yuyv":
            if frame.encoding != "yuv422_yuy2":
                raise UsageError(f"`payload` yuyv: this source delivers {frame.encoding}; use raw")
            return {"type": raw_mime(frame, frame.encoding), "bytes": frame.data.size}, frame
        media_type, data = encoded(frame, payload, trace)
        return {"type": media_type, "bytes": data.size}, replace(frame, data=data)

    def _answer(self, pending: Any, bounds: Bounds) -> Iterator[AnswerPart]:
        """Wake the server, and yield the parts of its answer as they arrive; raises RequestFailed, ServerDied."""
        stream, heard_ns, wake = bytearray(), now_ns(), self._wake
        try:
            if not pending.number_of_server_connections:
                raise self._failed("it has earlier requests of this client to answer")
            if wake is not None:
                wake.notify()
            while True:
                connected = pending.is_connected  # before the look: what was sent before an end is read
                response = pending.receive()
                if response is None:
                    self._wait(connected, heard_ns, bounds)
                    continue
                bounds.left_s()
                self._read_slice(bytes_in(response), stream, bounds)
                del response
                yield from unpacked(stream)
                heard_ns = now_ns()
        except ERRORS as error:
            raise self._failed(error) from error
        except (ValueError, KeyError, TypeError, struct.error) as error:
            raise RequestFailed(f"{self._name} sent a malformed answer: {error!r}") from error

    def _read_slice(self, data: memoryview, stream: bytearray, bounds: Bounds) -> None:
        """Add a slice of this answer to its stream; raises MessagesLost for one that came too late."""
        number, before = SLICE.unpack_from(data)
        if number != self._number:
            return
        if before != self._read[0]:
            raise MessagesLost(f"pieces of the answer of {self._name} were lost")
        bounds.count_bytes(len(data))
        stream += data[SLICE.size :]
        self._read[0] += 1

    def _wait(self, connected: bool, heard_ns: int, bounds: Bounds) -> None:
        """Wait a moment; raises RequestFailed, or ServerDied, for what has ended or was silent for too long."""
        domain, listener, most_s = self._domain, self._listener, self._wiring.timeout_s
        if domain is None or listener is None:
            raise self._failed("this client was closed")
        if not connected:
            raise self._failed("it gave the request up")
        if (now_ns() - heard_ns) / 1e9 > most_s:
            raise RequestFailed(f"nothing came from {self._name} for {most_s:g} s")
        if not wait(listener, min(POLL_S, bounds.left_s(), most_s)):
            domain.clean()
            if self._server_ended():
                raise self._failed("")

    def _server_ended(self) -> bool:
        return not self._alive() or (self._server is not None and not listens(self._server))

    def _failed(self, why: object) -> RequestFailed | ServerDied:
        if self._server_ended():
            return ServerDied(f"the server at {self._name} has ended")
        return RequestFailed(f"{self._name} broke off: {why}")
