"""The server core of all transports: queue, deadlines, bytes in flight, disconnected clients, errors.

A transport's framing reads requests, makes an `Exchange` of each and passes it to `Core.answer`, on a thread that may
wait: one for each connection, or one of `SharedSourceWorkers` where many clients share a socket or a topic.

The queue is bounded and first come, first served, with one answer at a time. Every `Turn` must be left; leaving twice
does no harm, and leaving while waiting gives the place up. `Limits.answer_s` after a request's arrival its wait, or its
answer at the next piece, ends with Overdue.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from threading import Event, Lock, Semaphore, Thread, current_thread
from typing import Final, TypeAlias

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, EngineError, Overdue, S2AError, TooLarge
from s2a_bench.machine.clocks import REALTIME_ERROR_MS, REALTIME_MS, WALL_CLOCKS
from s2a_bench.machine.tuning import give_back_memory
from s2a_bench.options import Options
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import ACTIONS, Handler
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.types import Action, Piece, Request, Token

CLOCK_PROMPT: Final = "s2a-bench exchanges time stamps: "
"""Followed by `TOKENS` or `ACTIONS`, the prompt of a request that is answered without the engine, for its marks.

With one of `machine.clocks.WALL_CLOCKS` after that, the facts are those of the wall clock.
"""
RETRY_AFTER_S = 1.0
STUCK_S = 120
"""Silence after which a running answer counts as stuck: a long prompt on a small board takes its time."""
POLL_S = 0.1
"""Interval at which waiting requests check that their clients are still connected."""
READERS: Final = 8
"""Requests that are parsed and decoded at once, each of which may hold a large picture."""
IDLE_WORKERS: Final = 2
"""Idle threads of a shared source, one of which waits in its library."""
LARGE_BYTES: Final = 32 << 20
"""Requests from this size on give their memory back to the system at once."""
_log = logging.getLogger(__name__)


class Turn:
    """One request's place in the queue, then its time with the engine."""

    __slots__ = ("_answer_s", "_turns", "alive_ns", "deadline_ns", "ready")

    def __init__(self, turns: Turns, answer_s: float) -> None:
        self.ready: Event | None = None
        """Set when the turn starts; None if it started at once."""
        self.alive_ns = now_ns()
        """Time of the last piece of the answer, on CLOCK_MONOTONIC."""
        self.deadline_ns = self.alive_ns + round(answer_s * 1e9)
        self._answer_s = answer_s
        self._turns = turns

    @property
    def has_started(self) -> bool:
        return self.ready is None or self.ready.is_set()

    def wait(self, trace: Trace, disconnected: Callable[[], bool] = lambda: False) -> bool:
        """Wait on this thread, as `queue`; return False if the client is ``disconnected`` before. Raises Overdue."""
        if self.ready is None:
            return not disconnected()
        trace.mark(RESIDUAL)
        while not self.ready.wait(POLL_S):
            if disconnected():
                return False
            self.check(now_ns())
        if disconnected():
            return False
        trace.mark("queue")
        return True

    def alive(self, at_ns: int) -> None:
        self.alive_ns = at_ns
        self.check(at_ns)

    def check(self, at_ns: int) -> None:
        if at_ns > self.deadline_ns:
            state = "being answered" if self.has_started else "waiting for the engine"
            raise Overdue(
                f"{self._answer_s:g} s after its arrival the request is still {state}: the server gives it up"
            )

    def leave(self) -> None:
        self._turns.leave(self)


class Turns:
    """The queue: one turn runs, at most ``limits.waiting`` wait, in the order of their arrival."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        self._limits = limits
        self._lock = Lock()
        self._running: Turn | None = None
        self._waiting: deque[Turn] = deque()

    def join(self) -> Turn:
        turn = Turn(self, self._limits.answer_s)
        with self._lock:
            if self._running is None:
                self._running = turn
                return turn
            if len(self._waiting) >= self._limits.waiting:
                waiting = f"{self._limits.waiting} requests are waiting for the engine already"
                raise Busy(f"{waiting}; come again later", retry_after_s=RETRY_AFTER_S)
            turn.ready = Event()
            self._waiting.append(turn)
        return turn

    def leave(self, turn: Turn) -> None:
        with self._lock:
            if turn is not self._running:
                if turn in self._waiting:
                    self._waiting.remove(turn)
                return
            self._running = following = self._waiting.popleft() if self._waiting else None
        if following is not None and following.ready is not None:
            following.alive_ns = now_ns()  # else its wait would count as the silence of `silent_s`
            following.ready.set()

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def silent_s(self) -> float:
        """Return the time since the running answer's last piece; 0 if none runs."""
        running = self._running
        return (now_ns() - running.alive_ns) / 1e9 if running is not None else 0.0


Answering: TypeAlias = "Callable[[Request, Trace, Turn], Generator[Piece, None, None]]"
"""Answers in its turn, and leaves it as soon as the engine is free."""


class Queued:
    """A handler that answers one request at a time; `answer` is for a caller that has its turn already."""

    def __init__(
        self, answering: Answering, limits: Limits = LIMITS, provenance: Mapping[str, str] | None = None
    ) -> None:
        """Put a queue in front of ``answering``; every answer carries its ``provenance``."""
        self.turns = Turns(limits)
        self.settings: Options | None = None
        """The engine's options, if known: a node has them as parameters."""
        self.honours: Collection[str] = ()
        """Names in `Request.sampling` that the engine honours."""
        self.provenance = dict(provenance or {})
        self._answering = answering

    @staticmethod
    def around(handler: Handler, limits: Limits = LIMITS) -> Queued:
        if isinstance(handler, Queued):
            return handler

        def answering(request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:
            with closing(handler(request, trace)) as tokens:
                for token in tokens:
                    turn.alive(now_ns())
                    yield token

        return Queued(answering, limits)

    def __call__(self, request: Request, trace: Trace) -> Generator[Piece, None, None]:
        turn = self.turns.join()
        try:
            turn.wait(trace)
            yield from self.answer(request, trace, turn)
        finally:
            turn.leave()

    def answer(self, request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:
        trace.provenance = self.provenance
        trace.mark(RESIDUAL)
        try:
            turn.check(now_ns())
            yield from (_stamped if request.prompt.startswith(CLOCK_PROMPT) else self._answering)(request, trace, turn)
        finally:
            turn.leave()


def _stamped(request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:  # noqa: ARG001
    """Answer a client that compares its clock with this host's; at the piece the answer leaves."""
    kind, _, system = request.prompt.removeprefix(CLOCK_PROMPT).partition(" ")
    if system in WALL_CLOCKS:
        clock = WALL_CLOCKS[system]()
        trace.facts |= {REALTIME_MS: clock.offset_ns / 1e6, REALTIME_ERROR_MS: clock.error_ns / 1e6}
    trace.mark("inference")
    trace.token_ns.append(trace.marks[-1][1])
    yield Action(0, np.zeros(1, np.float32)) if kind == ACTIONS else Token(0, ".")


class Disconnected(Exception):
    """The client has disconnected: nothing can be sent to it."""


class Exchange:
    """One request and its answer, as a transport frames them; all is called on the thread of `Core.answer`."""

    parse_stage = RESIDUAL
    """The stage of what `request` does after its last mark."""

    def __init__(self, trace: Trace | None = None) -> None:
        """Keep the trace, or start one: the framing marks it from the last received byte on."""
        self.trace = trace or Trace()
        self.ends_ns = 0
        """Deadline of the answer on CLOCK_MONOTONIC; set when the request joins the queue."""
        self.held = ExitStack()
        """The resources of the request, its bytes in flight; released before `end`, which may wait."""

    def sent_whole(self) -> None:
        """Mark an answer that is sent as a whole: the time of its later pieces is `inference` too."""
        if len(self.trace.token_ns) > 1:
            self.trace.marks.append(("inference", self.trace.token_ns[-1]))

    def left_s(self) -> float:
        return max(0.0, (self.ends_ns - now_ns()) / 1e9)

    def request(self) -> Request:
        """Parse and decode the request; raises RequestFailed."""
        raise NotImplementedError

    def accept(self) -> None:
        """Note that the request has joined the queue."""

    def begin(self, request: Request) -> Request | None:
        """Note that its turn has started; return the request for the engine, None if it was cancelled."""
        return request

    def send(self, piece: Piece) -> bool:
        """Send a piece without waiting for the client; return whether more are wanted. Raises Disconnected."""
        raise NotImplementedError

    def end(self) -> None:
        """Send the end of the answer, with the marks; the engine is free, so this may wait. Raises Disconnected."""
        raise NotImplementedError

    def fail(self, error: S2AError) -> None:
        raise NotImplementedError

    def disconnected(self) -> bool:
        return False

    def abandon(self) -> None:
        """Handle a client that was `disconnected` before its turn; return only if an end must be sent nevertheless."""
        raise Disconnected


class InFlight:
    """The bytes of all unanswered requests of a server, headers included."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._lock, self.bytes = limits, Lock(), 0

    @contextmanager
    def counted(self) -> Iterator[Callable[[int], None]]:
        """Count one request for as long as the context lasts; yield the function that adds to its size.

        That function raises TooLarge for too many bytes of one request, Busy for too many together.
        """
        held = 0

        def count(size: int) -> None:
            nonlocal held
            with self._lock:
                held += size
                self.bytes += size
            if held > self._limits.body_bytes + self._limits.header_bytes:
                raise TooLarge(f"the request is larger than {self._limits.body_bytes} bytes")
            if self.bytes > self._limits.in_flight_bytes:
                most = f"requests of {self._limits.in_flight_bytes} bytes are under way already"
                raise Busy(most, retry_after_s=RETRY_AFTER_S)

        try:
            yield count
        finally:
            with self._lock:
                self.bytes -= held
            if held >= LARGE_BYTES:
                give_back_memory()


class Core:
    """Answers the exchanges of a server, in the order of their arrival, one at a time."""

    def __init__(self, handler: Handler, limits: Limits) -> None:
        self.queued = Queued.around(handler, limits)
        self.limits = limits
        self.in_flight = InFlight(limits)
        self._reading = Semaphore(READERS)

    def join(self, exchange: Exchange) -> Turn:
        turn = self.queued.turns.join()
        exchange.ends_ns = turn.deadline_ns
        try:
            exchange.accept()
        except BaseException:
            turn.leave()
            raise
        return turn

    def answer(self, exchange: Exchange, turn: Turn | None = None) -> bool:
        """Read a request, wait for its turn and send the answer, or an error in one line.

        Return whether its end was sent; if not, the connection must be closed. ``turn`` comes from `join` if the
        request joined the queue on arrival; otherwise it joins once it is read.
        """
        try:
            try:
                with self._reading:
                    request = exchange.request()
                exchange.trace.mark(exchange.parse_stage)
                turn = turn or self.join(exchange)
                self._answer(exchange, request, turn)
            finally:
                if turn is not None:
                    turn.leave()
            exchange.held.close()  # before `end`, which may wait for a slow client
            exchange.end()
        except Disconnected:
            return False
        except Exception as error:  # noqa: BLE001 - every failure is reported to the client
            exchange.held.close()
            try:
                exchange.fail(client_error(error))
            except Disconnected:
                return False
        finally:
            exchange.held.close()
        return True

    def _answer(self, exchange: Exchange, request: Request, turn: Turn) -> None:
        if not turn.wait(exchange.trace, exchange.disconnected):
            exchange.abandon()
            return
        wanted = exchange.begin(request)
        if wanted is None:
            return
        with closing(self.queued.answer(wanted, exchange.trace, turn)) as pieces:
            for piece in pieces:
                if not exchange.send(piece):
                    break

    def stuck(self) -> str:
        silent_s = self.queued.turns.silent_s()
        return f"the answer under way has shown no sign of life for {silent_s:.0f} s" if silent_s > STUCK_S else ""


class SharedSourceWorkers:
    """The threads of a source that many clients share: one at a time waits for a request.

    The thread that received a request answers it while another waits, so that no request changes threads. One thread
    always waits; surplus threads end when they are idle.
    """

    def __init__(self, take: Callable[[], Callable[[], object] | None], stopped: Event) -> None:
        """Receive with ``take``, which waits a moment and returns the function that answers a request, or None."""
        self._take, self._stopped = take, stopped
        self._waits, self._count = Lock(), Lock()
        self._idle = 0
        self._threads: list[Thread] = []

    def start(self) -> None:
        with self._count:
            for _ in range(IDLE_WORKERS):
                self._start_one()

    def join(self) -> None:
        """Wait for all threads; no thread is started after the first has ended."""
        while self._threads:
            self._threads.pop().join()

    def _start_one(self) -> None:
        thread = Thread(target=self._work, name="worker", daemon=True)
        thread.start()
        self._idle += 1
        self._threads.append(thread)

    def _work(self) -> None:
        while not self._stopped.is_set():
            answer = None  # gives the received bytes back before the next wait
            try:
                with self._waits:
                    answer = self._take()
                if answer is not None:
                    self._busy(1)
                    try:
                        answer()
                    finally:
                        self._busy(-1)
                    if self._retired():
                        return
            except Exception as error:  # noqa: BLE001 - a server stays up: the next request may fare better
                _log.error("request not answered: %s", error or type(error).__name__)

    def _busy(self, change: int) -> None:
        with self._count:
            self._idle -= change
            if not self._idle and not self._stopped.is_set():
                try:
                    self._start_one()
                except RuntimeError as error:  # this one waits again once it has answered
                    _log.warning("no thread for the next request: %s", error)

    def _retired(self) -> bool:
        """Return True if enough other threads are idle, so that this one ends."""
        with self._count:
            if self._idle <= IDLE_WORKERS or self._stopped.is_set():
                return False
            self._idle -= 1
            self._threads.remove(current_thread())
        return True


def client_error(error: Exception) -> S2AError:
    """Return the error that the client gets; an internal error goes to the log."""
    if isinstance(error, S2AError):
        return error
    _log.error("a request failed", exc_info=error)
    return EngineError("internal error; the server's log has it")
