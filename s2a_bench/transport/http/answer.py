"""An answer over HTTP: it waits for its turn on the loop, computes on one thread of the pool, and is streamed or whole.

Whoever asked may go at any time: while it waits, it leaves the queue; later the answer ends at its next token.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Generator, Iterator
from itertools import chain
from threading import Thread
from typing import Any

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, Response

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError
from s2a_bench.facts import PROMPT_N
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport.http import own
from s2a_bench.transport.turns import Queued
from s2a_bench.types import Request, Token

STREAM_HEADERS = [(b"content-type", b"text/event-stream; charset=utf-8")]


class Answer(Response):
    """One request from its place in the queue to the last byte of its answer."""

    def __init__(self, queued: Queued, request: Request, trace: Trace, codec: own.Codec, *, stream: bool) -> None:
        """Join the queue; raises Busy."""
        super().__init__()
        self._request, self._trace, self._codec, self._stream = request, trace, codec, stream
        self._gone = False
        self._first: list[Token] | None = None
        self._on_thread = False
        self._turn = queued.turns.join()
        self._tokens = queued.answer(request, trace, self._turn)

    def begin(self) -> bool:
        """Take the first token on this thread if it is this request's turn; raises what the engine raises."""
        if self._turn.has_come:
            self._on_thread = True
            self._first = list(next_of(self._tokens))
            self._on_thread = False
        return self._first is not None

    def close(self) -> None:
        """Leave the engine, or the queue."""
        self._tokens.close()
        self._turn.leave()

    def abandon(self) -> None:
        """Close what no thread will close."""
        self._gone = True
        if not self._on_thread:
            Thread(target=self.close, daemon=True).start()  # closing may wait for the engine

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Wait for the turn if it has not come, then answer."""
        gone = asyncio.ensure_future(_gone(receive))
        gone.add_done_callback(self._leave)
        try:
            if self._first is None:
                self._trace.mark(RESIDUAL)
                if self._turn.come is not None:
                    come = asyncio.wrap_future(self._turn.come)
                    timeout = self._turn.left_s()
                    await asyncio.wait({come, gone}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                if self._gone:
                    return
                self._turn.check(now_ns())
                self._trace.mark("queue")
                await run_in_threadpool(self.begin)
            self._on_thread = True
            if not self._stream:
                await JSONResponse(await run_in_threadpool(self._whole))(scope, receive, send)
                return
            pieces = self._relayed()
            await send({"type": "http.response.start", "status": 200, "headers": STREAM_HEADERS})
            async for piece in pieces:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
        finally:
            gone.cancel()
            self._gone = True

    def _leave(self, _: object) -> None:
        self._gone = True

    def _wanted(self) -> Iterator[Token]:
        """Yield the tokens for as long as somebody wants them."""
        for token in chain(self._first or (), self._tokens):
            if self._gone:
                return
            yield token

    def _whole(self) -> dict[str, Any]:
        """Return the answer as one object."""
        try:
            tokens = list(self._wanted())
        finally:
            self.close()
        message = {"role": "assistant", "content": "".join(token.text for token in tokens)}
        return {
            "id": self._request.id,
            "object": "chat.completion",
            "model": "s2a",
            "choices": [{"index": 0, "message": message, "finish_reason": self._finish_reason(len(tokens))}],
            "usage": self._usage(len(tokens)),
            "s2a": own.remote_json(self._trace.to_remote()),
        }

    def _relayed(self) -> AsyncIterator[bytes]:
        """Start the answer on one thread, and return what it writes: a thread's turn a token would cost 50 us each."""
        loop, written, waiting = asyncio.get_running_loop(), asyncio.Event(), deque[bytes]()

        def run() -> None:
            try:
                for event in self._events():
                    waiting.append(event)
                    loop.call_soon_threadsafe(written.set)
            finally:
                self.close()

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

    def _events(self) -> Generator[bytes, None, None]:
        """Yield the server-sent events; an engine that fails on the way ends them with an error event."""
        count, dumps, request_id = 0, self._codec.dumps, self._request.id
        try:
            for token in self._wanted():
                event = own.chunk(request_id, {"content": token.text})
                event["choices"][0]["token"] = token.id
                yield b"data: " + dumps(event) + b"\n\n"
                count += 1
        except S2AError as error:
            yield b"data: " + dumps({"error": {"message": str(error), "type": type(error).__name__}}) + b"\n\n"
            return
        yield b"data: " + dumps(own.chunk(request_id, {}, self._finish_reason(count))) + b"\n\n"
        last = own.chunk(request_id, {}, usage=self._usage(count), s2a=own.remote_json(self._trace.to_remote()))
        yield b"data: " + dumps(last) + b"\n\ndata: [DONE]\n\n"

    def _finish_reason(self, count: int) -> str:
        return "length" if count >= self._request.max_tokens else "stop"

    def _usage(self, count: int) -> dict[str, int]:
        prompt = int(self._trace.facts.get(PROMPT_N, 0))
        return {"prompt_tokens": prompt, "completion_tokens": count, "total_tokens": prompt + count}


async def _gone(receive: Callable[[], Any]) -> None:
    """Return when the client has gone."""
    while (await receive())["type"] != "http.disconnect":
        pass


def next_of(tokens: Iterator[Token]) -> Iterator[Token]:
    """Yield at most the next token."""
    for token in tokens:
        yield token
        return
