"""The client: pictures are converted into the shared memory itself, and tokens read where the server wrote them."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from typing import Any

import orjson

from s2a_bench.errors import RequestFailed, ServerDied, UsageError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.bounds import Bounds
from s2a_bench.transport.pictures import bgr_of, encoded
from s2a_bench.transport.shm import ShmOptions
from s2a_bench.transport.shm.memory import (
    ANSWER_BYTES,
    EVENT,
    HELLO,
    PACKET,
    PICTURES_AT,
    READ,
    REQUEST,
    Memory,
    offered,
    receive,
)
from s2a_bench.transport.shm.ring import read
from s2a_bench.types import Frame, Request, Token

GROWS_BY = 1 << 20


class ShmClient:
    """One link to a server, and memory for requests that grows as they do."""

    camera = None

    def __init__(self, wiring: Wiring[ShmOptions], alive: Callable[[], bool]) -> None:
        """Connect; raises ServerDied where nobody listens."""
        self._wiring, self._alive, self._path = wiring, alive, wiring.address
        self._payload = wiring.options.payload
        self._link: socket.socket | None = None
        self._requests: Memory | None = None
        self._answers: Memory | None = None
        self._connect()

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Write the request, tell of it, yield the tokens."""
        bounds = Bounds(self._path, self._wiring.deadline_of(request.max_tokens), request.max_tokens)
        done = False
        try:
            for event in self._events(*self._send(request, trace), bounds):
                if "error" in event:
                    done = True
                    raise RequestFailed(f"the server broke off: {event['error']}")
                if "remote" in event:
                    done = True
                    trace.receive(Remote.of_json(event["remote"]))
                    return
                if not event["index"]:
                    trace.mark("return")
                bounds.piece()
                yield Token(event["index"], event["text"], event["id"])
        except TimeoutError as error:
            bounds.left_s()  # tells if it was the deadline
            raise RequestFailed(f"nothing came from {self._path} for {self._wiring.timeout_s:g} s") from error
        except (OSError, EOFError) as error:
            if not self._alive():
                raise ServerDied(f"the server at {self._path} is gone") from error
            raise RequestFailed(f"{self._path} broke off: {error or 'it closed the link'}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise RequestFailed(f"{self._path} sent what is no answer: {error!r}") from error
        finally:
            if not done:  # what was not read belongs to this request only
                self.close()

    def describe(self) -> dict[str, str]:
        """Add nothing: the wiring tells all."""
        return {}

    def close(self) -> None:
        """Close the link; the memory goes with its last user."""
        if self._link is not None:
            self._link.close()
        self._link = self._requests = self._answers = None

    def _connect(self) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            link.settimeout(self._wiring.timeout_s)
            link.connect(self._path)
        except OSError as error:
            link.close()
            raise ServerDied(f"nobody listens at {self._path}: {error.strerror or error}") from error
        self._link = link
        return link

    def _send(self, request: Request, trace: Trace) -> tuple[socket.socket, Memory]:
        """Lay pictures and header out in memory, and ring; return the link and that memory."""
        link = self._link or self._connect()
        pictures = [self._picture(frame, trace) for frame in request.images]
        fields = {name: getattr(request, name) for name in ("id", "prompt", "max_tokens", "grammar", "seed")}
        header = orjson.dumps({**fields, "images": [about for about, _ in pictures]})
        size = sum(about["bytes"] for about, _ in pictures)
        trace.mark("header_pack")
        memory = self._memory(link, PICTURES_AT + size + len(header))
        at = PICTURES_AT
        for about, frame in pictures:
            place = memory.bytes[at : at + about["bytes"]]
            if about["encoding"] == "bgr8":
                bgr_of(frame, trace, place.reshape(frame.height, frame.width, 3))
            else:
                place[:] = frame.data.reshape(-1)
            at += about["bytes"]
        memory.bytes[at : at + len(header)] = memoryview(header)
        trace.mark("header_pack")
        trace.facts[PAYLOAD_BYTES] = size + len(header)
        link.settimeout(self._wiring.timeout_s)
        link.send(PACKET.pack(REQUEST, at, len(header)))
        return link, memory

    def _picture(self, frame: Frame, trace: Trace) -> tuple[dict[str, Any], Frame]:
        """Return what the header says of a picture, and what is to be written."""
        if self._payload == "raw":
            size = 3 * frame.width * frame.height
            return {"encoding": "bgr8", "width": frame.width, "height": frame.height, "bytes": size}, frame
        if self._payload == "yuyv":
            if frame.encoding != "yuv422_yuy2":
                raise UsageError(f"`payload` yuyv: this source delivers {frame.encoding}; use raw")
            sides = {"width": frame.width, "height": frame.height}
            return {"encoding": frame.encoding, **sides, "bytes": frame.data.size}, frame
        kind, data = encoded(frame, self._payload, trace)
        made = Frame(frame.index, frame.stamp_ns, frame.width, frame.height, "jpeg", data)
        return {"encoding": kind, "width": frame.width, "height": frame.height, "bytes": data.size}, made

    def _memory(self, link: socket.socket, size: int) -> Memory:
        """Return memory of at least that size, larger than what was there if need be."""
        if self._requests is None or self._requests.size < size:
            self._requests = offered(link, -(-size // GROWS_BY) * GROWS_BY)
        return self._requests

    def _events(self, link: socket.socket, requests: Memory, bounds: Bounds) -> Iterator[dict[str, Any]]:
        """Yield what the server writes."""
        while True:
            link.settimeout(min(self._wiring.timeout_s, bounds.left_s()))
            what, first, second, files = receive(link)
            if what == HELLO:
                self._answers = Memory.received(files, first, ANSWER_BYTES)
                continue
            if what != EVENT or self._answers is None:
                raise ValueError(f"a packet that is none of an answer: {what!r}")
            bounds.came(second)
            event = orjson.loads(read(self._answers, first, second))
            READ.pack_into(requests.bytes.data, 0, first + second)
            yield event
