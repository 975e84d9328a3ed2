"""An answer as deployed: it waits for its turn on the loop, computes on one thread of the pool, is streamed or whole.

Whoever asked may go at any time: while it waits, it leaves the queue; later the answer ends at its next token.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from threading import Thread
from typing import Any

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, Response

from s2a_bench.clock import now_ns
from s2a_bench.trace import RESIDUAL
from s2a_bench.transport.http.reply import Reply

STREAM_HEADERS = [(b"content-type", b"text/event-stream; charset=utf-8")]


class Answer(Response):
    """One reply on its way through ASGI."""

    def __init__(self, reply: Reply) -> None:
        """Send nothing yet."""
        super().__init__()
        self._reply = reply
        self._begun = self._on_thread = False

    def begin(self) -> None:
        """Take the first token on this thread if it is this request's turn; raises what the engine raises."""
        if self._reply.turn.has_come:
            self._on_thread = True
            self._reply.begin()
            self._begun = True
            self._on_thread = False

    def abandon(self) -> None:
        """Close what no thread will close."""
        self._reply.gone = True
        if not self._on_thread:
            Thread(target=self._reply.close, daemon=True).start()  # closing may wait for the engine

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Wait for the turn if it has not come, then answer."""
        gone = asyncio.ensure_future(_gone(receive))
        gone.add_done_callback(self._leave)
        turn, trace = self._reply.turn, self._reply.trace
        try:
            if not self._begun:
                trace.mark(RESIDUAL)
                if turn.come is not None:
                    come = asyncio.wrap_future(turn.come)
                    timeout = turn.left_s()
                    await asyncio.wait({come, gone}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                if self._reply.gone:
                    return
                turn.check(now_ns())
                trace.mark("queue")
                await run_in_threadpool(self.begin)
            self._on_thread = True
            if not self._reply.stream:
                await JSONResponse(await run_in_threadpool(self._reply.whole))(scope, receive, send)
                return
            pieces = self._relayed()
            await send({"type": "http.response.start", "status": 200, "headers": STREAM_HEADERS})
            async for piece in pieces:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
        finally:
            gone.cancel()
            self._reply.gone = True

    def _leave(self, _: object) -> None:
        self._reply.gone = True

    def _relayed(self) -> AsyncIterator[bytes]:
        """Start the answer on one thread, and return what it writes: a thread's turn a token would cost 50 us each."""
        loop, written, waiting = asyncio.get_running_loop(), asyncio.Event(), deque[bytes]()

        def run() -> None:
            try:
                for event in self._reply.events():
                    waiting.append(event)
                    loop.call_soon_threadsafe(written.set)
            finally:
                self._reply.close()

        answer = asyncio.ensure_future(run_in_threadpool(run))
        answer.add_done_callback(lambda _: written.set())

        async def pieces() -> AsyncIterator[bytes]:
            while not answer.done() or waiting:
                await written.wait()
                written.clear()
                if events := [waiting.popleft() for _ in range(len(waiting))]:
                    yield b"".join(events)
            answer.result()

        return pieces()


async def _gone(receive: Callable[[], Any]) -> None:
    """Return when the client has gone."""
    while (await receive())["type"] != "http.disconnect":
        pass
