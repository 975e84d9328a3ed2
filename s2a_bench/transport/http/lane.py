"""The lane of *best effort* and *binary*: from a body to the last byte of an answer on one thread, without a framework.

The door hands a request over when its body is there. One thread decodes the picture, and, if the engine is free, takes
the tokens and writes each to the socket itself: no token waits for the event loop. Only what a socket does not take at
once, as its client reads too slowly, goes through the loop. Whoever must wait for the engine holds no thread.
"""

from __future__ import annotations

import json
import logging
import os
import socket
from asyncio import AbstractEventLoop, TimerHandle, Transport
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from http import HTTPStatus
from threading import Lock
from typing import Final

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, EngineError, Overdue, S2AError
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport.http import blocks, own
from s2a_bench.transport.http.access import allowed
from s2a_bench.transport.http.reading import Buffer, Headers, of_json, of_picture
from s2a_bench.transport.http.reply import Reply
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.turns import Queued
from s2a_bench.types import Request

THREADS: Final = 8
"""One answers; the others read what comes meanwhile."""

Reads = Callable[[Headers, Buffer, Trace, Limits], tuple[Request, bool]]
READS: Final[Mapping[bytes, Reads]] = {
    own.PATHS[own.BEST_EFFORT].encode(): of_json,
    own.PATHS[own.BINARY].encode(): of_picture,
}


class Lane:
    """What all fast requests of a server share."""

    def __init__(self, queued: Queued, limits: Limits, key: str) -> None:
        """Answer with ``queued`` who has the ``key``."""
        self.queued, self.limits = queued, limits
        self.threads = ThreadPoolExecutor(THREADS, "http")
        self.calls: set[Call] = set()
        self._key = key.encode()

    def reads(self, method: bytes, url: bytes, headers: Headers) -> Reads | None:
        """Return what reads a request, None where it is for the application: another path, or nobody's key."""
        if method != b"POST" or (self._key and not allowed(headers, self._key)):
            return None
        return READS.get(url.partition(b"?")[0])

    def close(self) -> None:
        """Break off what is not answered yet."""
        for call in list(self.calls):
            call.hang_up()
        self.threads.shutdown(wait=False, cancel_futures=True)


class Call:
    """One request whose body is there; `leave` and the door's side are the loop's, all else is a thread's."""

    def __init__(
        self, lane: Lane, loop: AbstractEventLoop, transport: Transport, answered: Callable[[bool], None]
    ) -> None:
        """Write to the socket of ``transport``; tell ``answered`` whether the connection may be kept."""
        self._lane, self._loop, self._transport, self._answered = lane, loop, transport, answered
        self._out = socket.socket(fileno=os.dup(transport.get_extra_info("socket").fileno()))
        self._reply: Reply | None = None
        self._resumes = Lock()  # held by who has let go on, or given up, a request that waits for the engine
        self._late: TimerHandle | None = None
        self._gone = self._spilled = self._started = self._chunks = self._keep = self._binary = False
        lane.calls.add(self)

    def start(self, reads: Reads, headers: Headers, body: Buffer, *, chunks: bool, keep: bool) -> None:
        """Answer on a thread; without ``chunks`` the end of a stream is that of the connection."""
        trace = Trace()
        trace.mark("network")
        self._chunks, self._keep = chunks, keep and chunks
        self._binary = reads is of_picture
        self._lane.threads.submit(self._read, reads, headers, body, trace)

    def leave(self) -> None:
        """Take note that the client has gone, or that the connection has to end."""
        self._gone = True
        if (reply := self._reply) is not None:
            reply.gone = True
            if reply.turn.come is not None and self._resumes.acquire(blocking=False):
                reply.turn.leave()
                self._over(keep=False)
        with suppress(OSError):
            self._out.shutdown(socket.SHUT_RDWR)

    def hang_up(self) -> None:
        """Break the connection."""
        self.leave()
        self._transport.abort()

    def _read(self, reads: Reads, headers: Headers, body: Buffer, trace: Trace) -> None:
        """Join the queue, and answer if nobody is before us."""
        if self._gone:
            self._over(keep=False)
            return
        try:
            request, stream = reads(headers, body, trace, self._lane.limits)
            reply = Reply(self._lane.queued, request, trace, own.FAST, stream=stream)
        except Exception as error:  # noqa: BLE001 - who asked must hear of it, whatever broke
            self._fail(error)
            return
        self._reply, reply.gone = reply, self._gone
        if reply.turn.has_come:
            if self._resumes.acquire(blocking=False):
                self._answer(reply)
            return
        trace.mark(RESIDUAL)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._wait, reply)

    def _wait(self, reply: Reply) -> None:
        """Go on when the turn comes, or at the deadline."""
        if reply.turn.come is not None:
            self._give_up(reply)
            reply.turn.come.add_done_callback(lambda _: self._resume(reply))
        if self._gone:
            self.leave()

    def _give_up(self, reply: Reply) -> None:
        """Go on, to a refusal, at the deadline; timers may be early."""
        if left_s := reply.turn.left_s():
            self._late = self._loop.call_later(left_s, self._give_up, reply)
        else:
            self._resume(reply)

    def _resume(self, reply: Reply) -> None:
        if self._resumes.acquire(blocking=False):
            with suppress(RuntimeError):  # the server has ended
                self._lane.threads.submit(self._go_on, reply)

    def _go_on(self, reply: Reply) -> None:
        """Answer a request that had to wait."""
        try:
            reply.turn.check(now_ns())
        except Overdue as late:
            reply.close()
            self._fail(late)
            return
        reply.trace.mark("queue")
        self._answer(reply)

    def _answer(self, reply: Reply) -> None:
        """Write the answer as it comes."""
        try:
            if not self._gone:
                reply.begin()
                if reply.stream:
                    self._stream(reply)
                else:
                    self._write(self._whole("200 OK", own.FAST.dumps(reply.whole())))
        except Exception as error:  # noqa: BLE001 - as above
            reply.close()
            self._fail(error)
        else:
            reply.close()
            self._over(keep=self._keep)

    def _stream(self, reply: Reply) -> None:
        """Write each event, the first with the headers."""
        as_bytes = self._binary and reply.acts
        kind = blocks.MEDIA_TYPE if as_bytes else "text/event-stream; charset=utf-8"
        head = ["HTTP/1.1 200 OK", f"content-type: {kind}", *self._connection()]
        data = "\r\n".join([*head, *["transfer-encoding: chunked"] * self._chunks, "", ""]).encode()
        for event in reply.blocks() if as_bytes else reply.events():
            self._write(data + (b"%x\r\n%b\r\n" % (len(event), event) if self._chunks else event))
            data = b""
        if self._chunks:
            self._write(b"0\r\n\r\n")

    def _fail(self, error: Exception) -> None:
        """Refuse, or break off what has begun."""
        if not isinstance(error, S2AError):
            logging.getLogger("uvicorn.error").error("a request failed", exc_info=error)
            error = EngineError("Internal Server Error")
        if self._started:
            self._over(keep=False)
            return
        status = own.status_of(error)
        retry = [f"retry-after: {error.retry_after_s:.0f}"] if isinstance(error, Busy) else []
        body = json.dumps(own.error_json(status, str(error))).encode()
        self._write(self._whole(f"{status} {HTTPStatus(status).phrase}", body, *retry))
        self._over(keep=self._keep)

    def _whole(self, status: str, body: bytes, *headers: str) -> bytes:
        """Return a whole answer of JSON."""
        head = [f"HTTP/1.1 {status}", "content-type: application/json", *headers, *self._connection()]
        return "\r\n".join([*head, f"content-length: {len(body)}", "", ""]).encode() + body

    def _connection(self) -> list[str]:
        return [] if self._keep else ["connection: close"]

    def _write(self, data: bytes) -> None:
        """Write on this thread for as long as the client reads as fast."""
        self._started = True
        if not self._spilled:
            try:
                sent = self._out.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            except OSError:
                self._gone = True
                if self._reply is not None:
                    self._reply.gone = True
                return
            data = data[sent:]
            self._spilled = bool(data)
        if data:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._spill, data)

    def _spill(self, data: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(data)

    def _over(self, *, keep: bool) -> None:
        """Give everything back, after what was spilled."""
        self._out.close()
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._ended, keep)

    def _ended(self, keep: bool) -> None:
        self._lane.calls.discard(self)
        if self._late is not None:
            self._late.cancel()
        self._answered(keep and not self._gone)
