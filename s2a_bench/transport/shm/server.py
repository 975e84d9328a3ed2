"""The server: a request is read where it lies, and the pieces of its answer are written into memory."""

from __future__ import annotations

import logging
import select
import socket
from contextlib import suppress
from mmap import MADV_REMOVE
from pathlib import Path
from threading import Event
from typing import Any, Final

import orjson

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError, TooLarge, TransportError
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.chunks import request_of, state_of
from s2a_bench.transport.connections import Connections, Wire, wait_at_most
from s2a_bench.transport.limits import Limits, check_pixels
from s2a_bench.transport.pictures import decoded, rgb_of
from s2a_bench.transport.serving import Core, Disconnected, Exchange
from s2a_bench.transport.shm import ShmOptions
from s2a_bench.transport.shm.memory import (
    ANSWER_BYTES,
    PLACE,
    STEP_BYTES,
    SharedMemory,
    accept,
    in_steps,
    offer,
    refusal,
)
from s2a_bench.transport.shm.pieces import packed
from s2a_bench.transport.shm.unix_socket import listen
from s2a_bench.types import Frame, Piece, Request

BYTES_A_PIXEL: Final = {"bgr8": 3, "yuv422_yuy2": 2}
LAST_BYTES: Final = 1 << 12
"""Room for what ends an answer; its marks may take what the pieces have left."""
_log = logging.getLogger(__name__)


def request_at(memory: SharedMemory, at: int, length: int, limits: Limits, trace: Trace) -> Request:
    """Parse a header, and read its pictures as the engine takes them; raises RequestFailed."""
    fields = orjson.loads(memory.map[at : at + length])
    trace.mark("header_parse")
    images, begin, pixels = [], 0, limits.pixels
    for about in fields["images"]:
        images.append(_picture(memory, about, begin, trace, pixels))
        pixels -= images[-1].pixel_count
        begin += about["bytes"]
    return request_of(fields, limits, fields["id"], fields["prompt"], tuple(images), state_of(fields["state"]))


def _picture(memory: SharedMemory, about: dict[str, Any], begin: int, trace: Trace, most_pixels: int) -> Frame:
    """Convert a picture; raw pixels are read where they lie, a file that has a size of its own is copied first."""
    encoding, end = about["encoding"], begin + about["bytes"]
    if encoding not in BYTES_A_PIXEL:
        return decoded(encoding, memory.map[begin:end], trace, most_pixels)
    width, height = about["width"], about["height"]
    check_pixels(width, height, most_pixels)
    pixels = memory.pixels[begin:end].reshape(height, width, BYTES_A_PIXEL[encoding])
    return rgb_of(Frame(-1, 0, width, height, encoding, pixels), trace)


class ShmServer:
    def __init__(self, wiring: Wiring[ShmOptions], handler: Handler) -> None:
        """Bind; raises PortInUse, TransportError."""
        self._core = Core(handler, wiring.limits)
        listener, self.address = listen(wiring.address)
        most = wiring.limits.connections
        self._connections = Connections(listener, self._answer_all, most, refusal(f"{most} links are open already"))
        self.serve = self._connections.serve
        self._stopped = Event()

    def describe(self) -> dict[str, str | int]:
        return {"server": "shared memory (memfd), Unix socket"}

    def stop(self) -> None:
        if not self._stopped.is_set():
            with suppress(OSError):
                Path(self.address).unlink()  # while it is ours
        self._stopped.set()
        self._connections.stop()

    def _answer_all(self, wire: Wire) -> None:
        link, limits = wire.socket, self._core.limits
        try:
            wait_at_most(link, limits.head_s)
            requests = accept(link, in_steps(limits.body_bytes))
            writer = Writer(wire, offer(link, ANSWER_BYTES))
            wait_at_most(link, 0)
        except TransportError as error:
            wire.sendall(refusal(str(error)))
            _log.warning("a link was closed: %s", error)
            return
        while packet := link.recv(PLACE.size + 1):
            exchange = ShmExchange(wire, requests, writer, PLACE.unpack(packet), self._core)
            exchange.trace.mark("network")
            if not self._core.answer(exchange):
                return


class Writer:
    """An answer in memory: it lies there whole, so that a client which is slow to read never holds the engine."""

    def __init__(self, wire: Wire, answers: SharedMemory) -> None:
        self._wire, self._answers = wire, answers
        self._announced = self._end = 0

    def begin(self) -> None:
        """Begin at 0 again; the memory of a long answer is given back."""
        if self._end > STEP_BYTES:
            self._answers.map.madvise(MADV_REMOVE)
        self._announced = self._end = 0

    def send(self, piece: bytes, room: int = LAST_BYTES) -> None:
        """Write a piece and tell of it, with ``room`` left for more; raises Disconnected."""
        end = self._end + len(piece)
        if end + room > ANSWER_BYTES:
            raise RequestFailed(
                f"an answer of more than {ANSWER_BYTES - LAST_BYTES} bytes, and this wire carries no more"
            )
        self._answers.map[self._end : end] = piece
        self._end = end
        self._announce()

    def end(self, piece: bytes) -> None:
        """Write the last piece, which may be marks that are too long."""
        fits = self._end + len(piece) <= ANSWER_BYTES
        self.send(piece if fits else packed(f"{len(piece)} bytes of marks: too long an answer"), 0)

    def finish(self, left_s: float) -> None:
        """Tell of the rest, waiting for a slow client for so long; raises Disconnected."""
        ends_ns = now_ns() + round(left_s * 1e9)
        writable = select.poll()
        writable.register(self._wire.socket, select.POLLOUT)
        while self._announced < self._end:
            if not writable.poll(max(0, ends_ns - now_ns()) / 1e6):
                raise Disconnected("the client does not read its answer")
            self._announce()

    def _announce(self) -> None:
        """Announce what was written, if the client has read earlier announcements; raises Disconnected."""
        try:
            place = PLACE.pack(self._announced, self._end - self._announced)
            self._wire.socket.send(place, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            return
        except OSError as error:
            raise Disconnected from error
        self._announced = self._end


class ShmExchange(Exchange):
    parse_stage = "header_parse"

    def __init__(
        self,
        wire: Wire,
        requests: SharedMemory,
        writer: Writer,
        place: tuple[int, int],
        core: Core,
    ) -> None:
        super().__init__()
        self.disconnected = wire.disconnected  # type: ignore[method-assign]
        self._requests, self._writer, self._place, self._core = requests, writer, place, core
        writer.begin()

    def request(self) -> Request:
        size, limits = sum(self._place), self._core.limits
        if size > limits.body_bytes:
            raise TooLarge(f"the request is larger than {limits.body_bytes} bytes")
        self.held.enter_context(self._core.in_flight.counted())(size)
        return request_at(self._requests, *self._place, limits, self.trace)

    def send(self, piece: Piece) -> bool:
        self._writer.send(packed(piece))
        return True

    def end(self) -> None:
        self._last(self.trace.to_remote())

    def fail(self, error: S2AError) -> None:
        self._last(str(error))

    def _last(self, part: Remote | str) -> None:
        self._writer.end(packed(part))
        self._writer.finish(self.left_s())
