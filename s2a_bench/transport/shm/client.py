"""The client: pictures are converted into the shared memory itself, and pieces read where the server wrote them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import orjson

from s2a_bench.errors import RequestFailed, ServerDied, UsageError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.connections import wait_at_most
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.pictures import bgr_of, encoded
from s2a_bench.transport.shm import ShmOptions
from s2a_bench.transport.shm.memory import ANSWER_BYTES, PLACE, STEP_BYTES, SharedMemory, accept, in_steps, offer
from s2a_bench.transport.shm.pieces import AnswerPart, unpacked
from s2a_bench.transport.shm.unix_socket import connect, remove_if_dead
from s2a_bench.types import Action, Frame, Piece, Request, Token

NEARER_S: Final = 0.1
"""A wait that ends later than it should by no more than this is left as it is: to change it is a system call."""


class ShmClient(Client):
    """One link to a server; a request that does not fit opens another, with more memory."""

    def __init__(self, wiring: Wiring[ShmOptions], alive: Callable[[], bool]) -> None:
        """Connect; raises ServerDied if no server listens."""
        self._wiring, self._alive, self._path = wiring, alive, wiring.address
        self._payload = wiring.options.payload
        self._link: ShmConnection | None = None
        self._connect(STEP_BYTES)

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        bounds = self._wiring.bounds(self._path, request.max_tokens)
        link, at, length = self._lay_out(request, trace)
        done = False
        try:
            self._ask(link, at, length)
            for part in self._answer(link, bounds):
                if isinstance(part, (Token, Action)):
                    if not part.index:
                        trace.mark("return")
                    yield part
                    continue
                done = True
                if isinstance(part, str):
                    raise RequestFailed(f"the server broke off: {part}")
                trace.receive(part)
                return
        finally:
            if not done:  # what was not read belongs to this request only
                self.close()

    def close(self) -> None:
        """Close the link; the memory goes with its last user, the socket of a server that was killed is removed."""
        if self._link is not None:
            self._link.close()
        self._link = None
        if not self._alive():
            remove_if_dead(Path(self._path))

    def _connect(self, size: int) -> ShmConnection:
        self.close()
        try:
            self._link = ShmConnection(self._path, size, self._wiring.timeout_s)
        except OSError as error:
            raise ServerDied(f"no server accepts connections at {self._path}: {error.strerror or error}") from error
        return self._link

    def _lay_out(self, request: Request, trace: Trace) -> tuple[ShmConnection, int, int]:
        """Write pictures and header into memory; return the link, and where the header lies."""
        pictures = [self._picture(frame, trace) for frame in request.images]
        size = sum(about["bytes"] for about, _ in pictures)
        fields = {
            "id": request.id,
            "prompt": request.prompt,
            "max_tokens": request.max_tokens,
            "grammar": request.grammar,
            "seed": request.seed,
            "state": request.state,
            "images": [about for about, _ in pictures],
        }
        header = orjson.dumps(fields)
        needed = size + len(header)
        trace.mark("header_pack")
        link = self._link
        if link is None or link.requests.size < needed:
            link = self._connect(in_steps(needed))
            trace.mark("connect")
        at = 0
        for about, frame in pictures:
            place = link.requests.pixels[at : at + about["bytes"]]
            if about["encoding"] == "bgr8":
                bgr_of(frame, trace, place.reshape(frame.height, frame.width, 3))
            else:
                place[:] = frame.data.reshape(-1)
            at += about["bytes"]
        link.requests.map[at : at + len(header)] = header
        trace.facts[PAYLOAD_BYTES] = size + len(header)
        trace.mark("header_pack")
        return link, at, len(header)

    def _picture(self, frame: Frame, trace: Trace) -> tuple[dict[str, Any], Frame]:
        about: dict[str, Any] = {"encoding": "bgr8", "width": frame.width, "height": frame.height}
        if self._payload == "raw":
            return {**about, "bytes": 3 * frame.width * frame.height}, frame
        if self._payload == "yuyv":
            if frame.encoding != "yuv422_yuy2":
                raise UsageError(f"`payload` yuyv: this source delivers {frame.encoding}; use raw")
            return {**about, "encoding": frame.encoding, "bytes": frame.data.size}, frame
        media_type, data = encoded(frame, self._payload, trace)
        made = Frame(frame.index, frame.stamp_ns, frame.width, frame.height, "jpeg", data)
        return {**about, "encoding": media_type, "bytes": data.size}, made

    def _ask(self, link: ShmConnection, at: int, length: int) -> None:
        try:
            link.ask(at, length)
        except OSError as error:
            raise self._disconnected(error) from error

    def _answer(self, link: ShmConnection, bounds: Bounds) -> Iterator[AnswerPart]:
        try:
            while True:
                data = link.next(min(self._wiring.timeout_s, bounds.left_s()))
                bounds.count_bytes(len(data))
                yield from unpacked(data)
        except BlockingIOError as error:
            bounds.left_s()  # tells if it was the deadline
            raise RequestFailed(f"nothing came from {self._path} for {self._wiring.timeout_s:g} s") from error
        except (OSError, EOFError) as error:
            raise self._disconnected(error) from error
        except (ValueError, KeyError, TypeError, struct.error) as error:
            raise RequestFailed(f"{self._path} sent what is no answer: {error!r}") from error

    def _disconnected(self, error: Exception) -> RequestFailed | ServerDied:
        if not self._alive():
            return ServerDied(f"the server at {self._path} has ended")
        return RequestFailed(f"{self._path} broke off: {str(error) or 'it closed the link'}")


class ShmConnection:
    """A connection with memory for requests of ``size`` bytes."""

    def __init__(self, path: str, size: int, patience_s: float) -> None:
        """Connect and offer memory; raises OSError, TransportError."""
        self._socket = connect(path, patience_s)
        self._waits_s = patience_s
        self._answers: SharedMemory | None = None
        try:
            self.requests = offer(self._socket, size)
        except BaseException as error:
            with self._socket:
                self._reason(error)
            raise

    def ask(self, at: int, length: int) -> None:
        """Tell of a request whose header lies there; raises OSError, TransportError."""
        try:
            self._socket.send(PLACE.pack(at, length))
        except OSError as error:
            self._reason(error)
            raise

    def next(self, wait_s: float) -> bytes:
        """Return the pieces that were written meanwhile; raises BlockingIOError after ``wait_s``.

        Raises what `accept` does, too, and struct.error for a packet that is none.
        """
        if not self._waits_s - NEARER_S <= wait_s <= self._waits_s + NEARER_S:
            wait_at_most(self._socket, wait_s)
            self._waits_s = wait_s
        if self._answers is None:
            self._answers = accept(self._socket, ANSWER_BYTES)
        packet = self._socket.recv(PLACE.size + 1)
        if not packet:
            raise EOFError
        begin, length = PLACE.unpack(packet)
        return self._answers.map[begin : begin + length]

    def _reason(self, error: BaseException) -> None:
        if isinstance(error, BrokenPipeError | ConnectionResetError) and self._answers is None:
            with suppress(OSError, EOFError):
                accept(self._socket, ANSWER_BYTES)

    def close(self) -> None:
        self._socket.close()
