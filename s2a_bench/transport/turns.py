"""The queue in front of an engine: bounded, first come first served, one answer at a time.

Every server has one `Queued` handler. Called, it waits for its turn on the caller's thread; a server whose threads must
not wait (HTTP has a pool of 40) joins `turns` itself, waits as it likes for `Turn.come`, and then calls `answer`.
Whoever joined must leave, whatever happens; leaving twice does no harm, and leaving while waiting gives the place up.
From its arrival a request has `Limits.answer_s`: then its wait, or its answer at the next token, ends with Overdue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from contextlib import closing
from threading import Lock
from typing import TYPE_CHECKING, TypeAlias

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, Overdue
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.types import Piece, Request

if TYPE_CHECKING:
    from s2a_bench.options import Options
    from s2a_bench.transport import Handler

RETRY_AFTER_S = 1.0
STUCK_S = 120
"""Silence of an answer under way after which it counts as stuck: a long prompt on a small board takes its time."""
POLL_S = 0.1
"""How often one who waits is asked whether it still wants an answer."""


class Turn:
    """One request's place in the queue, then its time with the engine."""

    __slots__ = ("_answer_s", "_turns", "alive_ns", "come", "deadline_ns")

    def __init__(self, turns: Turns, answer_s: float) -> None:
        """Take a place; only `Turns.join` does."""
        self.come: Future[None] | None = None
        """Done when it is this request's turn; None where it was at once, for a Future costs 30 us."""
        self.alive_ns = now_ns()
        """When the answer last showed a sign of life, on CLOCK_MONOTONIC."""
        self.deadline_ns = self.alive_ns + round(answer_s * 1e9)
        """When the whole answer has to be over."""
        self._answer_s = answer_s
        self._turns = turns

    @property
    def has_come(self) -> bool:
        """Whether it is this request's turn, or was."""
        return self.come is None or self.come.done()

    def wait(self, gone: Callable[[], bool] = lambda: False) -> bool:
        """Wait on this thread; return False if who asked was ``gone`` before its turn came. Raises Overdue."""
        while self.come is not None:
            try:
                self.come.result(POLL_S)
            except NotYet:
                if gone():
                    return False
                self.check(now_ns())
            else:
                break
        return True

    def start(self) -> None:
        """Let it be this request's turn."""
        self.alive_ns = now_ns()
        if self.come is not None:
            self.come.set_result(None)

    def alive(self, at_ns: int) -> None:
        """Note a sign of life; raises Overdue."""
        self.alive_ns = at_ns
        self.check(at_ns)

    def check(self, at_ns: int) -> None:
        """Raise Overdue after the deadline."""
        if at_ns > self.deadline_ns:
            doing = "waiting for the engine" if not self.has_come else "being answered"
            raise Overdue(f"{self._answer_s:g} s after it came the request is still {doing}: the server gives it up")

    def left_s(self) -> float:
        """Return the time to the deadline."""
        return max(0.0, (self.deadline_ns - now_ns()) / 1e9)

    def leave(self) -> None:
        """End the turn, or give up the place; may be called twice, from any thread."""
        self._turns.leave(self)


class Turns:
    """The queue: one turn runs, at most ``limits.waiting`` wait for theirs in the order of their arrival."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        """Start idle."""
        self._limits = limits
        self._lock = Lock()
        self._running: Turn | None = None
        self._waiting: deque[Turn] = deque()

    def join(self) -> Turn:
        """Take the last place; raises Busy where as many as may are waiting."""
        turn = Turn(self, self._limits.answer_s)
        with self._lock:
            if self._running is None:
                self._running = turn
                return turn
            if len(self._waiting) >= self._limits.waiting:
                waiting = f"{self._limits.waiting} requests are waiting for the engine already"
                raise Busy(f"{waiting}; come again later", retry_after_s=RETRY_AFTER_S)
            turn.come = Future()
            turn.come.set_running_or_notify_cancel()  # so that nobody can cancel it
            self._waiting.append(turn)
        return turn

    def leave(self, turn: Turn) -> None:
        """Take ``turn`` out and let the next one run if it ran."""
        with self._lock:
            if turn is not self._running:
                if turn in self._waiting:
                    self._waiting.remove(turn)
                return
            self._running = following = self._waiting.popleft() if self._waiting else None
        if following is not None:
            following.start()

    @property
    def waiting(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def silent_s(self) -> float:
        """Return for how long the running answer has shown no sign of life; 0 where none runs."""
        running = self._running
        return (now_ns() - running.alive_ns) / 1e9 if running is not None else 0.0


Answering: TypeAlias = "Callable[[Request, Trace, Turn], Generator[Piece, None, None]]"
"""What answers in its turn, and leaves as soon as the engine is free: what it does then, nobody waits for."""


def whole(pieces: Generator[Piece, None, None], trace: Trace) -> list[Piece]:
    """Take an answer that is sent as one: what its later pieces took is `inference` too."""
    with closing(pieces):
        taken = list(pieces)
    if len(trace.token_ns) > 1:
        trace.marks.append(("inference", trace.token_ns[-1]))
    return taken


class Queued:
    """A handler that answers one request at a time; `answer` is for who has its turn already."""

    def __init__(
        self, answering: Answering, limits: Limits = LIMITS, provenance: Mapping[str, str] | None = None
    ) -> None:
        """Put a queue in front of ``answering``; ``provenance`` says who that is, and goes with every answer."""
        self.turns = Turns(limits)
        self.settings: Options | None = None
        """What the engine was told, where whoever made this says so: a node's parameters have it."""
        self.honours: Collection[str] = ()
        """The names in `Request.sampling` that the engine honours."""
        self.provenance = dict(provenance or {})
        self._answering = answering

    @staticmethod
    def around(handler: Handler, limits: Limits = LIMITS) -> Queued:
        """Return ``handler``, with a queue in front of it if it has none."""
        if isinstance(handler, Queued):
            return handler

        def answering(request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:
            with closing(handler(request, trace)) as tokens:
                for token in tokens:
                    turn.alive(now_ns())
                    yield token

        return Queued(answering, limits)

    def __call__(self, request: Request, trace: Trace) -> Generator[Piece, None, None]:
        """Wait for a turn and answer; raises Busy or Overdue.

        What taking a free turn costs, some 2 us, is the engine's time.
        """
        trace.provenance = self.provenance
        trace.mark(RESIDUAL)
        turn = self.turns.join()
        try:
            if turn.come is not None:
                turn.wait()
                trace.mark("queue")
            yield from self._answering(request, trace, turn)
        finally:
            turn.leave()

    def answer(self, request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:
        """Answer in a turn that has come, and leave it."""
        trace.provenance = self.provenance
        trace.mark(RESIDUAL)
        try:
            turn.check(now_ns())
            yield from self._answering(request, trace, turn)
        finally:
            turn.leave()
