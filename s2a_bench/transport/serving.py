"""The server core, once for all transports: queue, deadlines, bytes under way, clients that have gone, errors.

A transport's framing reads requests, makes an `Exchange` of each and has it answered by `Core.answer`, on a thread that
may wait: one a connection where there are connections, one of a pool where many clients share a socket or a topic.

The queue is bounded, first come first served, one answer at a time. Who joined must leave, whatever happens; leaving
twice does no harm, and leaving while waiting gives the place up. From its arrival a request has `Limits.answer_s`:
then its wait, or its answer at the next piece, ends with Overdue.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from threading import Event, Lock, Semaphore, Thread, current_thread
from typing import TYPE_CHECKING, Final, TypeAlias

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, EngineError, Overdue, S2AError, TooLarge
from s2a_bench.machine.tuning import give_back_memory
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
READERS: Final = 8
"""Requests that are parsed and decoded at once, each of which may hold a large picture."""
IDLE_WORKERS: Final = 2
"""Threads that wait for requests of a shared source, one in its library."""
LARGE_BYTES: Final = 32 << 20
"""From here on what a request left behind is given back to the system at once."""
_log = logging.getLogger(__name__)


class Turn:
    """One request's place in the queue, then its time with the engine."""

    __slots__ = ("_answer_s", "_turns", "alive_ns", "deadline_ns", "ready")

    def __init__(self, turns: Turns, answer_s: float) -> None:
        """Take a place; only `Turns.join` does."""
        self.ready: Event | None = None
        """Set when it is this request's turn; None where it was at once."""
        self.alive_ns = now_ns()
        """When the answer last showed a sign of life, on CLOCK_MONOTONIC."""
        self.deadline_ns = self.alive_ns + round(answer_s * 1e9)
        """When the whole answer has to be over."""
        self._answer_s = answer_s
        self._turns = turns

    @property
    def has_started(self) -> bool:
        """Whether it is this request's turn, or was."""
        return self.ready is None or self.ready.is_set()

    def wait(self, disconnected: Callable[[], bool] = lambda: False) -> bool:
        """Wait on this thread; return False if the client was ``gone`` before its turn came. Raises Overdue."""
        while self.ready is not None and not self.ready.wait(POLL_S):
            if disconnected():
                return False
            self.check(now_ns())
        return not disconnected()

    def alive(self, at_ns: int) -> None:
        """Note a sign of life; raises Overdue."""
        self.alive_ns = at_ns
        self.check(at_ns)

    def check(self, at_ns: int) -> None:
        """Raise Overdue after the deadline."""
        if at_ns > self.deadline_ns:
            doing = "waiting for the engine" if not self.has_started else "being answered"
            raise Overdue(f"{self._answer_s:g} s after it came the request is still {doing}: the server gives it up")

    def leave(self) -> None:
        """End the turn, or give up the place; may be called twice, from any thread."""
        self._turns.leave(self)


class Turns:
    """The queue: one turn runs, at most ``limits.waiting`` wait for theirs in the order of their arrival."""

    def __init__(self, limits: Limits = LIMITS) -> None:
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
            turn.ready = Event()
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
        if following is not None and following.ready is not None:
            following.alive_ns = now_ns()
            following.ready.set()

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def silent_s(self) -> float:
        """Return for how long the running answer has shown no sign of life; 0 where none runs."""
        running = self._running
        return (now_ns() - running.alive_ns) / 1e9 if running is not None else 0.0


Answering: TypeAlias = "Callable[[Request, Trace, Turn], Generator[Piece, None, None]]"
"""What answers in its turn, and leaves as soon as the engine is free: what it does then, nobody waits for."""


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
        """Wait for a turn and answer; raises Busy or Overdue."""
        turn = self.turns.join()
        try:
            if turn.ready is not None:
                trace.mark(RESIDUAL)
                turn.wait()
                trace.mark("queue")
            yield from self.answer(request, trace, turn)
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


class Disconnected(Exception):
    """The client has gone: nothing can be sent to it."""


class Exchange:
    """One request and its answer, as a transport frames them; all is called on the thread of `Core.answer`."""

    def __init__(self, trace: Trace | None = None) -> None:
        """Keep its trace, or start one: the framing marks it from the last received byte on."""
        self.trace = trace or Trace()
        self.ends_ns = 0
        """When the answer has to be over, on CLOCK_MONOTONIC; known once the request has its place in the queue."""
        self.held = ExitStack()
        """What the request holds, its bytes under way: given back before the answer's end, which may wait."""

    def sent_whole(self) -> None:
        """Mark an answer that is sent as one: what its later pieces took is `inference` too."""
        if len(self.trace.token_ns) > 1:
            self.trace.marks.append(("inference", self.trace.token_ns[-1]))

    def left_s(self) -> float:
        """Return the time until then."""
        return max(0.0, (self.ends_ns - now_ns()) / 1e9)

    def request(self) -> Request:
        """Parse and decode the request; raises RequestFailed."""
        raise NotImplementedError

    def accept(self) -> None:
        """Note that the request has its place in the queue."""

    def begin(self, request: Request) -> Request | None:
        """Note that its turn has come; return what the engine is asked, None where no answer is wanted any more."""
        return request

    def send(self, piece: Piece) -> bool:
        """Send a piece without waiting for the client; return whether more are wanted. Raises Disconnected."""
        raise NotImplementedError

    def end(self) -> None:
        """Send the end of the answer, with the marks; the engine is free, so this may wait. Raises Disconnected."""
        raise NotImplementedError

    def fail(self, error: S2AError) -> None:
        """Send in one line why there is no answer, or no more of it. Raises Disconnected."""
        raise NotImplementedError

    def disconnected(self) -> bool:
        """Whether the client has disconnected or cancelled."""
        return False

    def abandon(self) -> None:
        """Note that it was `gone` when its turn came; where an end has to be sent all the same, this only returns."""
        raise Disconnected


class InFlight:
    """The bytes of all requests of a server that are not answered yet, headers included."""

    def __init__(self, limits: Limits) -> None:
        """Allow ``limits.body_bytes`` a request and ``limits.in_flight_bytes`` together."""
        self._limits, self._lock, self.bytes = limits, Lock(), 0

    @contextmanager
    def counted(self) -> Iterator[Callable[[int], None]]:
        """Count one request while it lasts: what is given is called with the size of all that comes of it.

        That raises TooLarge for too many bytes of one request, Busy for too many together.
        """
        held = 0

        def came(size: int) -> None:
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
            yield came
        finally:
            with self._lock:
                self.bytes -= held
            if held >= LARGE_BYTES:
                give_back_memory()


class Core:
    """Answers the exchanges of a server, in the order of their arrival, one at a time."""

    def __init__(self, handler: Handler, limits: Limits) -> None:
        """Answer with ``handler``, within ``limits``."""
        self.queued = Queued.around(handler, limits)
        self.limits = limits
        self.in_flight = InFlight(limits)
        self._reading = Semaphore(READERS)

    def join(self, exchange: Exchange) -> Turn:
        """Give a request its place in the queue; raises Busy."""
        turn = self.queued.turns.join()
        exchange.ends_ns = turn.deadline_ns
        try:
            exchange.accept()
        except BaseException:
            turn.leave()
            raise
        return turn

    def answer(self, exchange: Exchange, turn: Turn | None = None) -> bool:
        """Read a request, wait for its turn and send the answer, or what failed in one line.

        Return whether its end was sent; else the connection, if there is one, has to be closed.

        ``turn`` is what `join` returned where that was called when it came; else it joins once it is read.
        """
        try:
            try:
                with self._reading:
                    request = exchange.request()
                turn = turn or self.join(exchange)
                self._answer(exchange, request, turn)
            finally:
                if turn is not None:
                    turn.leave()
            exchange.held.close()
            exchange.end()
        except Disconnected:
            return False
        except Exception as error:  # noqa: BLE001 - the client must hear of it, whatever broke
            return _fail(exchange, client_error(error))
        finally:
            exchange.held.close()
        return True

    def _answer(self, exchange: Exchange, request: Request, turn: Turn) -> None:
        """Send the pieces once the request's turn has come, as long as they are wanted."""
        waits = turn.ready is not None
        if waits:
            exchange.trace.mark(RESIDUAL)
        if not turn.wait(exchange.disconnected):
            exchange.abandon()
            return
        if waits:
            exchange.trace.mark("queue")
        wanted = exchange.begin(request)
        if wanted is None:
            return
        with closing(self.queued.answer(wanted, exchange.trace, turn)) as pieces:
            for piece in pieces:
                if not exchange.send(piece):
                    break

    def stuck(self) -> str:
        """Return what is wrong with the answer under way, nothing where all is well."""
        silent_s = self.queued.turns.silent_s()
        return f"the answer under way has shown no sign of life for {silent_s:.0f} s" if silent_s > STUCK_S else ""


class SharedSourceWorkers:
    """The threads of a source that many clients share: they take turns in waiting for a request.

    The one that got a request answers it while another waits, so that no request changes threads. One is always left
    to wait; those that were started while all others answered end when they are idle.
    """

    def __init__(self, take: Callable[[], Callable[[], None] | None], stopped: Event) -> None:
        """Have one thread at a time ``take``: wait a moment for a request, and return what answers it if one came."""
        self._take, self._stopped = take, stopped
        self._waits, self._count = Lock(), Lock()
        self._idle = 0
        self._threads: list[Thread] = []

    def start(self) -> None:
        """Start the first threads."""
        with self._count:
            for _ in range(IDLE_WORKERS):
                self._start_one()

    def join(self) -> None:
        """Wait for all threads; none is started any more once the first has ended."""
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
        """Return whether enough others are idle, so that this thread ends."""
        with self._count:
            if self._idle <= IDLE_WORKERS or self._stopped.is_set():
                return False
            self._idle -= 1
            self._threads.remove(current_thread())
        return True


def client_error(error: Exception) -> S2AError:
    """Return what a client is told of what a request raised; a bug is for the log."""
    if isinstance(error, S2AError):
        return error
    _log.error("a request failed", exc_info=error)
    return EngineError("internal error; the server's log has it")


def _fail(exchange: Exchange, error: S2AError) -> bool:
    exchange.held.close()
    try:
        exchange.fail(error)
    except Disconnected:
        return False
    return True
