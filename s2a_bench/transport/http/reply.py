"""The words of an answer, streamed or whole, whoever sends them: a place in the queue, then tokens, then events."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from itertools import chain, islice
from typing import Any

from s2a_bench.errors import S2AError
from s2a_bench.facts import PROMPT_N
from s2a_bench.trace import Trace
from s2a_bench.transport.http import blocks, own
from s2a_bench.transport.turns import Queued
from s2a_bench.types import Action, Piece, Request


def content(pieces: Sequence[Piece]) -> str:
    """Return an answer as one text; actions as a JSON list of theirs."""
    acts = any(isinstance(piece, Action) for piece in pieces)
    return f"[{', '.join(piece.text for piece in pieces)}]" if acts else "".join(piece.text for piece in pieces)


class Reply:
    """One request from its place in the queue to its last event."""

    def __init__(self, queued: Queued, request: Request, trace: Trace, codec: own.Codec, *, stream: bool) -> None:
        """Join the queue; raises Busy."""
        self.stream = stream
        self.gone = False
        """Whether who asked has gone; then the answer ends at its next token."""
        self.trace = trace
        self.turn = queued.turns.join()
        self._request, self._codec = request, codec
        self._tokens = queued.answer(request, trace, self.turn)
        self._first: list[Piece] = []

    def begin(self) -> None:
        """Take the first token on this thread; raises what the engine raises."""
        self._first = list(islice(self._tokens, 1))

    def close(self) -> None:
        """Leave the engine, or the queue."""
        self._tokens.close()
        self.turn.leave()

    def whole(self) -> dict[str, Any]:
        """Return the answer as one object."""
        try:
            tokens = list(self._wanted())
        finally:
            self.close()
        message = {"role": "assistant", "content": content(tokens)}
        return {
            "id": self._request.id,
            "object": "chat.completion",
            "model": "s2a",
            "choices": [{"index": 0, "message": message, "finish_reason": self._finish_reason(len(tokens))}],
            "usage": self._usage(len(tokens)),
            "s2a": self.trace.to_remote().to_json(),
        }

    def events(self) -> Generator[bytes, None, None]:
        """Yield the server-sent events; an engine that fails on the way ends them with an error event."""
        count, dumps, request_id = 0, self._codec.dumps, self._request.id
        try:
            for piece in self._wanted():
                if isinstance(piece, Action):
                    event = own.chunk(request_id, {})
                    event["choices"][0] |= {"tick": piece.index, "action": piece.values.tolist()}
                else:
                    event = own.chunk(request_id, {"content": piece.text})
                    event["choices"][0]["token"] = piece.id
                yield b"data: " + dumps(event) + b"\n\n"
                count += 1
        except S2AError as error:
            yield b"data: " + dumps({"error": {"message": str(error), "type": type(error).__name__}}) + b"\n\n"
            return
        yield b"data: " + dumps(own.chunk(request_id, {}, self._finish_reason(count))) + b"\n\n"
        last = own.chunk(request_id, {}, usage=self._usage(count), s2a=self.trace.to_remote().to_json())
        yield b"data: " + dumps(last) + b"\n\ndata: [DONE]\n\n"

    @property
    def acts(self) -> bool:
        """Whether the answer that has begun is one of actions."""
        return any(isinstance(piece, Action) for piece in self._first)

    def blocks(self) -> Generator[bytes, None, None]:
        """Yield an answer of actions as `blocks`."""
        count = 0
        try:
            for piece in self._wanted():
                if isinstance(piece, Action):
                    yield blocks.of_action(piece)
                    count += 1
        except S2AError as error:
            yield blocks.of_json({"error": {"message": str(error), "type": type(error).__name__}})
            return
        last = own.chunk(self._request.id, {}, self._finish_reason(count), s2a=self.trace.to_remote().to_json())
        yield blocks.of_json(last)

    def _wanted(self) -> Iterator[Piece]:
        """Yield the pieces for as long as somebody wants them."""
        for token in chain(self._first, self._tokens):
            if self.gone:
                return
            yield token

    def _finish_reason(self, count: int) -> str:
        return "length" if count >= self._request.max_tokens else "stop"

    def _usage(self, count: int) -> dict[str, int]:
        prompt = int(self.trace.facts.get(PROMPT_N, 0))
        return {"prompt_tokens": prompt, "completion_tokens": count, "total_tokens": prompt + count}
