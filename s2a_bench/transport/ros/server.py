"""The ROS server: fronts receive requests, handlers answer them, the camera's newest frame is at hand.

A front is one variant's way in. Its threads take turns in waiting for a request; the one that got it answers it
while another waits, so that no request changes threads, and one that comes meanwhile waits for the engine (stage
`queue`), not in the network. All fronts share one queue, which a request joins as it arrives: a front's lock is held
until it has its place and who asked knows that, so requests are accepted, answered and ended in one order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from threading import Event, Lock, Thread, current_thread
from typing import Any, Protocol

from s2a_bench.errors import Busy, MissingInterface, Overdue, RequestFailed
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.diagnostics import Finding
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.ros import ACTION
from s2a_bench.transport.ros.action_front import ActionFront
from s2a_bench.transport.ros.camera import POLL_S, CameraCache
from s2a_bench.transport.ros.joining import join, namespace_of, refuse_company, settled
from s2a_bench.transport.ros.node import Activity, NodeApi
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.topic import TopicFront
from s2a_bench.transport.ros.wire import PROVENANCE_TOPIC, provenance_message
from s2a_bench.transport.turns import Queued, Turn
from s2a_bench.types import Piece, Request

_log = logging.getLogger(__name__)


class Job(Protocol):
    """One request on its way to the engine and back."""

    trace: Trace

    def accept(self) -> None:
        """Tell who asked that the request has its place in the queue."""
        ...

    def prepare(self) -> Request | None:
        """Decode the pictures; None where that cannot be done: then only `end` is called."""
        ...

    def start(self) -> bool:
        """Note that the request's turn has come; return whether the answer is still wanted."""
        ...

    def token(self, token: Piece) -> bool:
        """Send a token; return whether more are wanted."""
        ...

    def unwanted(self) -> bool:
        """Whether who asked is known to want no answer any more."""
        ...

    def end(self, error: str = "") -> None:
        """Send the end of the answer."""
        ...


class Front(Protocol):
    """One variant's way in."""

    def take(self, timeout_s: float) -> Any | None:
        """Wait for the next request and return it packed; None on timeout or after `interrupt`."""
        ...

    def job(self, packed: Any, trace: Trace) -> Job | None:
        """Unpack a request; None for what is none, of which who asked, and the log, have been told."""
        ...

    def size_bytes(self, packed: Any) -> int:
        """Return how large a request is."""
        ...

    def refuse(self, packed: Any, why: str) -> None:
        """Tell who asked that the request is not taken."""
        ...

    def interrupt(self) -> None:
        """Make `take` return, callable from any thread."""
        ...


END_S = 5.0
"""The longest that an answer's end waits for that of the answer before."""
IDLE_WORKERS = 2
"""Threads of a front that wait for requests, one in the middleware; more are started while all others answer."""


class RosServer:
    """Answers the requests of all fronts."""

    def __init__(self, wiring: Wiring[RosOptions], handler: Handler) -> None:
        """Join the domain and create all topics; raises TransportError where another server answers already."""
        wiring, host = settled(wiring)
        self.address = wiring.address if host else namespace_of(wiring)
        namespace = namespace_of(wiring)
        self._queued = Queued.around(handler, wiring.limits)
        self._limits, self._held_bytes, self._holding = wiring.limits, 0, Lock()
        if not (wiring.restarted or host):
            refuse_company(wiring, namespace)
        self.middleware = join(wiring, "server", host=host)
        self._cache = CameraCache(self.middleware, namespace, wiring.options, wiring.limits)
        self._fronts: list[Front] = [TopicFront(self.middleware, namespace, wiring.limits)]
        self._action: ActionFront | None = None
        try:
            self._action = ActionFront(self.middleware, wiring, self._queued.honours)
            self._fronts.append(self._action)
        except MissingInterface as missing:  # of llama_msgs, which topics do not need
            if wiring.variant == ACTION:
                self.middleware.close()
                raise
            _log.warning("the action is not served: %s", missing)
        self._origin = self.middleware.publisher(  # kept: what is latched goes with its writer
            namespace + PROVENANCE_TOPIC, ros.PROVENANCE, QoS(depth=1, latched=True)
        )
        self._origin.send(self._origin.pack(provenance_message(self._queued.provenance)))
        self._stopped = Event()
        self._options = wiring.options
        turns = self._queued.turns
        self._activity = Activity(lambda: turns.waiting, wiring.limits.waiting, turns.silent_s)
        self._node = NodeApi.of(self.middleware, wiring, self._queued.settings, self._change, self._findings)
        self._ended = Event()
        """Set when the end of the last answer that was begun has been sent."""
        self._ended.set()

    def serve(self) -> None:
        """Serve until stopped."""
        crews = [_Crew(front, self._take, self._stopped) for front in self._fronts]
        self._cache.start()
        for crew in crews:
            crew.start()
        if self._node:
            self._node.start(self._stopped)
        self._stopped.wait()
        for crew in crews:
            crew.join()
        self._cache.join()
        if self._node:
            self._node.close()
        self.middleware.close()

    def stop(self) -> None:
        """Wake all threads."""
        self._stopped.set()
        for front in self._fronts:
            front.interrupt()
        self._cache.interrupt()

    def describe(self) -> dict[str, str | int]:
        """Say what carries the messages."""
        return self.middleware.describe()

    def _change(self, wanted: Mapping[str, Any]) -> None:
        """Set options while serving; raises UsageError."""
        self._options = self._options.but(**wanted)
        if self._action is not None:
            self._action.tune(self._options)

    def _findings(self) -> Iterator[Finding]:
        return self._activity.findings(*self._cache.seen(), self._options.max_frame_age)

    def _take(self, front: Front) -> Callable[[], None] | None:
        """Wait for a request and give it its place in the queue; return what answers it."""
        packed = front.take(POLL_S)
        if packed is None:
            return None
        trace = Trace()
        trace.mark("network")
        with ExitStack() as held:
            try:
                size = front.size_bytes(packed)
                self._hold(size)
                held.callback(self._hold, -size)
                job = front.job(packed, trace)
                if job is None:
                    self._activity.failed("it could not be read", told=True)
                    return None
                turn = self._queued.turns.join()
                held.callback(turn.leave)
            except RequestFailed as error:
                self._activity.failed(str(error), told=front is self._action)
                front.refuse(packed, str(error))
                return None
            job.accept()
            return partial(self._answer_in, turn, job, held.pop_all())

    def _hold(self, size: int) -> None:
        """Count what all requests hold; raises RequestFailed for one that is too large, or too large now."""
        with self._holding:
            if size > self._limits.body_bytes:
                raise RequestFailed(f"the request is larger than {self._limits.body_bytes} bytes")
            if self._held_bytes + size > self._limits.in_flight_bytes:
                raise Busy(f"requests of {self._limits.in_flight_bytes} bytes are under way already")
            self._held_bytes += size

    def _answer_in(self, turn: Turn, job: Job, held: ExitStack) -> None:
        """Prepare a request, answer it when its turn comes, and give back what it ``held``."""
        with held:
            request = job.prepare()
            if request is None:
                self._activity.failed("it could not be read or prepared")
                job.end()
            elif self._its_turn(turn, job):
                before, self._ended = self._ended, Event()  # in our turn, so one thread at a time
                ended = self._ended
                try:
                    if error := self._answer(request, job, turn):
                        self._activity.failed(error)
                    before.wait(END_S)
                    job.end(error)
                finally:
                    ended.set()

    def _its_turn(self, turn: Turn, job: Job) -> bool:
        """Wait for a request's turn; where it does not come, its job has ended."""
        if turn.come is not None:  # it had to wait, if only for as long as its pictures took
            job.trace.mark(RESIDUAL)
            try:
                turn.wait(lambda: job.unwanted() or self._stopped.is_set())
            except Overdue as late:
                job.end(str(late))
                return False
            job.trace.mark("queue")
        if self._stopped.is_set() or not turn.has_come:
            job.end("the server is stopping" if self._stopped.is_set() else "")
            return False
        return True

    def _answer(self, request: Request, job: Job, turn: Turn) -> str:
        """Answer a request whose turn has come; return what went wrong, for who asked."""
        self._activity.requests += 1
        try:
            if not job.start():
                return ""
            if not request.images:
                request = replace(request, images=self._cache.lend(job.trace))
            with closing(self._queued.answer(request, job.trace, turn)) as tokens:
                for token in tokens:
                    self._activity.tokens += 1
                    if self._stopped.is_set():
                        return "the server is stopping"
                    if not job.token(token):
                        break
        except Exception as failure:  # noqa: BLE001 - who asked must hear of it, whatever broke
            return str(failure) or type(failure).__name__
        return ""


class _Crew:
    """The threads of one front: they take turns in waiting for a request, and there is always one left to wait."""

    def __init__(self, front: Front, take: Callable[[Front], Callable[[], None] | None], stopped: Event) -> None:
        self._front, self._take, self._stopped = front, take, stopped
        self._lock, self._count = Lock(), Lock()
        self._idle = 0
        self._threads: list[Thread] = []

    def start(self) -> None:
        """Start the first threads."""
        for _ in range(IDLE_WORKERS):
            self._hire()

    def join(self) -> None:
        """Wait for all threads; none is hired any more once the first has ended."""
        while self._threads:
            self._threads.pop().join()

    def _hire(self) -> None:
        self._idle += 1
        thread = Thread(target=self._work, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _work(self) -> None:
        """Take requests when it is this thread's turn, and answer them while another thread waits."""
        while not self._stopped.is_set():
            answer = None  # gives the received bytes back before the next wait
            try:
                with self._lock:
                    answer = self._take(self._front)
                if answer is not None:
                    self._busy(1)
                    try:
                        answer()
                    finally:
                        self._busy(-1)
                    if self._retired():
                        return
            except Exception as error:  # noqa: BLE001 - a node stays up: the next request may fare better
                _log.error("request not answered: %s", error or type(error).__name__)

    def _busy(self, change: int) -> None:
        with self._count:
            self._idle -= change
            if not self._idle and not self._stopped.is_set():
                self._hire()

    def _retired(self) -> bool:
        """Whether enough others are idle, so that this thread ends."""
        with self._count:
            if self._idle <= IDLE_WORKERS or self._stopped.is_set():
                return False
            self._idle -= 1
            self._threads.remove(current_thread())
        return True
