"""The server: a thread for each link, which waits for its turn, and writes each token where its client reads it."""

from __future__ import annotations

import logging
import os
import socket
import struct
from contextlib import closing, suppress
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import orjson

from s2a_bench.errors import RequestFailed, S2AError, TransportError
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.limits import SEEDS, Limits, check_pixels, text, whole_number
from s2a_bench.transport.pictures import decoded, rgb_of
from s2a_bench.transport.shm import ShmOptions
from s2a_bench.transport.shm.memory import (
    ANSWER_BYTES,
    HELLO,
    PICTURES_AT,
    REQUEST,
    Memory,
    listen,
    offered,
    receive,
)
from s2a_bench.transport.shm.ring import Writer
from s2a_bench.transport.turns import Queued, Turn
from s2a_bench.types import Frame, Request, Token

CREDENTIALS = struct.Struct("3i")
BYTES_A_PIXEL = {"bgr8": 3, "yuv422_yuy2": 2}

_log = logging.getLogger(__name__)


class ShmServer:
    """Answers the clients of one user on one machine."""

    def __init__(self, wiring: Wiring[ShmOptions], handler: Handler) -> None:
        """Bind; raises PortInUse."""
        self._limits = wiring.limits
        self._queued = Queued.around(handler, wiring.limits)
        self._listener = listen(wiring.address)
        self.address = self._listener.getsockname()
        self._lock, self._links, self._stopped = Lock(), set[socket.socket](), False

    def describe(self) -> dict[str, str | int]:
        """Return what carries the requests."""
        return {"server": "shared memory (memfd), Unix socket"}

    def serve(self) -> None:
        """Serve until stopped."""
        while not self._stopped:
            try:
                link, _ = self._listener.accept()
            except OSError:
                break
            if self._welcome(link):
                Thread(target=self._answer_all, args=(link,), name="shm link", daemon=True).start()
            else:
                link.close()

    def stop(self) -> None:
        """Stop listening, and end every link."""
        self._stopped = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with suppress(OSError):
            Path(self.address).unlink()
        with self._lock:
            links = list(self._links)
        for link in links:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)

    def _welcome(self, link: socket.socket) -> bool:
        """Whether a client is one of this user's, and there is room."""
        _, user, _ = CREDENTIALS.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
        with self._lock:
            if user not in {0, os.getuid()} or len(self._links) >= self._limits.connections:
                return False
            self._links.add(link)
        return True

    def _answer_all(self, link: socket.socket) -> None:
        """Answer one request after the other."""
        requests: Memory | None = None
        writer: Writer | None = None
        try:
            while True:
                what, first, second, files = receive(link)
                trace = Trace()
                trace.mark("network")
                if what == HELLO:
                    requests = Memory.received(files, first, PICTURES_AT + self._limits.body_bytes)
                    writer = writer or Writer(offered(link, ANSWER_BYTES))
                elif what == REQUEST and requests is not None and writer is not None:
                    self._answer(link, requests, writer, (first, second), trace)
                else:
                    raise ValueError(f"a packet that is none of a request: {what!r}")
        except (OSError, EOFError):
            pass  # the client has gone
        except (ValueError, TransportError) as error:
            _log.warning("a link was closed: %s", error)
        finally:
            with self._lock:
                self._links.discard(link)
            link.close()

    def _answer(
        self, link: socket.socket, requests: Memory, writer: Writer, header: tuple[int, int], trace: Trace
    ) -> None:
        """Read a request, wait for its turn, write the answer."""
        turn: Turn | None = None

        def left_s() -> float:
            return turn.left_s() if turn else self._limits.answer_s

        try:
            request = self._read(requests, *header, trace)
            turn = self._queued.turns.join()
            if turn.come is not None:
                trace.mark(RESIDUAL)
                if not turn.wait(lambda: _gone(link)):
                    return
                trace.mark("queue")
            with closing(self._queued.answer(request, trace, turn)) as tokens:
                for token in tokens:
                    writer.send(link, _event(token), requests, left_s)
            last: dict[str, Any] = {"remote": trace.to_remote()}
        except S2AError as error:
            last = {"error": str(error)}
        finally:
            if turn is not None:
                turn.leave()
        writer.send(link, orjson.dumps(last), requests, left_s)

    def _read(self, memory: Memory, at: int, length: int, trace: Trace) -> Request:
        """Read header and pictures; raises RequestFailed."""
        if not (0 < length <= self._limits.body_bytes and at >= PICTURES_AT and at + length <= memory.size):
            raise RequestFailed(f"a header of {length} bytes at {at} is none")
        try:
            fields = orjson.loads(memory.bytes[at : at + length].tobytes())
        except ValueError as error:
            raise RequestFailed(f"the header is no JSON: {error}") from error
        trace.mark("header_parse")
        if not isinstance(fields, dict) or not isinstance(told := fields.get("images", []), list):
            raise RequestFailed("the header should be an object whose images are a list")
        images, begin = [], PICTURES_AT
        for about in told:
            size = about.get("bytes") if isinstance(about, dict) else None
            if type(size) is not int or size <= 0 or begin + size > at:
                raise RequestFailed("a picture should lie before the header")
            images.append(_picture(about, memory, begin, trace, self._limits))
            begin += size
        return Request(
            id=text("id", fields.get("id")),
            prompt=text("prompt", fields.get("prompt")),
            images=tuple(images),
            max_tokens=whole_number("max_tokens", fields.get("max_tokens"), 1, self._limits.answer_tokens, 32),
            grammar=text("grammar", fields.get("grammar")),
            seed=whole_number("seed", fields.get("seed"), 0, SEEDS, 0),
        )


def _picture(about: dict[str, Any], memory: Memory, begin: int, trace: Trace, limits: Limits) -> Frame:
    """Make what the engine takes of a picture; its pixels are read where they lie."""
    data = memory.bytes[begin : begin + about["bytes"]]
    encoding = text("encoding", about.get("encoding"))
    if encoding not in BYTES_A_PIXEL:
        return decoded(encoding, data.data, trace, limits)
    width, height = (whole_number(side, about.get(side), 1, limits.pixels, 0) for side in ("width", "height"))
    check_pixels(width, height, limits)
    if data.size != width * height * BYTES_A_PIXEL[encoding]:
        raise RequestFailed(f"{data.size} bytes are no {encoding} picture of {width}x{height}")
    pixels = data.reshape(height, width, BYTES_A_PIXEL[encoding])
    return rgb_of(Frame(-1, 0, width, height, encoding, pixels), trace)  # type: ignore[arg-type]


def _event(token: Token) -> bytes:
    return orjson.dumps({"index": token.index, "text": token.text, "id": token.id})


def _gone(link: socket.socket) -> bool:
    """Whether the client has closed its end; it has nothing to say while it waits."""
    try:
        return not link.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True
