"""Requests of a control loop: threads that measure them one after another, each with its client."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic
from types import SimpleNamespace
from typing import Any, Final, TypeAlias

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.session import Measured, Place, RequestContext, Session
from s2a_bench.types import Action, Frame, Piece, Vector

OnActions: TypeAlias = Callable[[int, Sequence[Vector], int], None]
"""Called with a request's number, the actions received so far, and the time in ns."""

SEEDS: Final = 2**31
GRACE_S: Final = 1.0
"""Time for answers in progress when a run ends early."""
LEAST_WAIT_S: Final = 0.1
MOST_WAIT_S: Final = 5.0
"""The longest wait for a server that names a time to retry."""


@dataclass(frozen=True, slots=True)
class Job:
    request: int
    tick: int
    state: tuple[float, ...]
    picture: Frame | None = None
    """The robot's; None: a camera's."""


@dataclass(slots=True)
class ChunkRequester:
    """Requests chunks in the background; measurements are put into ``done``.

    A request that fails before its chunk is complete is repeated, as the robot still waits for it; only the missing
    actions are taken from the new answer.
    """

    sessions: Sequence[Session]
    horizon: int
    seed: int
    streams: bool
    on_actions: OnActions
    blocks: Iterator[int]
    """The next place in the run."""
    warmup: int = 0
    """Attempts, marked as warm-ups, after which it is over; 0: no warm-ups, and no limit."""
    jobs: SimpleQueue[Job | None] = field(default_factory=SimpleQueue)
    done: SimpleQueue[tuple[Session, Measured]] = field(default_factory=SimpleQueue)
    names: dict[int, str] = field(default_factory=dict)
    """Request -> the id of its sample."""
    attempts: int = 0
    error: str = ""
    """The error of the last attempt."""
    dims: int = 0
    """Numbers of an action; 0 before the first."""
    sent_bytes: int = 0
    failure: BaseException | None = None
    over: Event = field(default_factory=Event)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Serve jobs during the block and until the last answer; for at most `GRACE_S` more if the block raises."""
        threads = [
            Thread(target=self.work, args=(session,), name=f"requester-{place}", daemon=True)
            for place, session in enumerate(self.sessions)
        ]
        for thread in threads:
            thread.start()
        patience_s: float | None = GRACE_S
        try:
            yield
            patience_s = None  # clients are not shared while in use; their limits end every answer
        finally:
            self.over.set()
            for _ in threads:
                self.jobs.put(None)
            until_s = monotonic() + GRACE_S
            for thread in threads:
                thread.join(None if patience_s is None else max(0, until_s - monotonic()))

    def work(self, session: Session) -> None:
        """Serve jobs on this thread until None or the end of the run."""
        try:
            while (job := self.jobs.get()) is not None and not self.over.is_set():
                self._ask(session, job)
        except BaseException as error:  # noqa: BLE001 - raised again by the thread that waits for the loop
            self.failure = self.failure or error

    def _ask(self, session: Session, job: Job) -> None:
        """Repeat the request until its chunk is complete, or the run is over."""
        chunk: list[Vector] = []
        if job.picture is not None:
            show(session, job.picture)
        for attempt in count():
            actions: list[Vector] = []

            def on_piece(piece: Piece, at_ns: int, actions: list[Vector] = actions) -> None:
                if isinstance(piece, Action):
                    actions.append(piece.values)
                    self.dims = piece.values.size
                if len(actions) > len(chunk) and (self.streams or len(actions) == self.horizon):
                    chunk.extend(actions[len(chunk) :])
                    self.on_actions(job.request, chunk, at_ns)

            place = Place(next(self.blocks), attempt, warmup=self.warmup > 0)
            request = replace(session.request, seed=(self.seed + job.tick) % SEEDS)
            measured = session.measure(place, RequestContext(job.state or None, on_piece, request=request))
            picture = measured.fingerprint if job.picture is None else place.block  # a world may look the same twice
            self.names[job.request] = measured.sample.request_id
            self.sent_bytes += measured.sample.payload_bytes or 0
            self.error = measured.sample.error
            self.done.put((session, replace(measured, fingerprint=picture)))
            self.attempts += 1
            if self.attempts == self.warmup:
                self.over.set()
            if not measured.sample.error:
                check_length(session.cell.name, len(actions), self.horizon)
            if not measured.sample.error or len(chunk) == self.horizon:
                return
            if measured.fatal is not None or self.over.wait(wait_s(measured)):
                return


def show(session: Session, picture: Frame) -> None:
    """Let the session's next requests carry a robot's picture."""
    still: Any = SimpleNamespace(read=lambda: picture)  # of a source, `read` is all that a feed needs
    if isinstance(session.feed, RequestFeed):
        session.feed = replace(session.feed, source=still)
        session.request = replace(session.request, size=f"{picture.width}x{picture.height}")


def wait_s(measured: Measured) -> float:
    """Return how long a robot waits before it repeats a failed request."""
    return min(max(measured.retry_after_s, LEAST_WAIT_S), MOST_WAIT_S)


def check_length(who: str, actions: int, horizon: int) -> None:
    """Raise UsageError for chunks that are not `horizon` long, RequestFailed for answers without actions."""
    if not actions:
        raise RequestFailed(f"{who} answers with tokens; acting needs a server that answers with chunks of actions")
    if actions != horizon:
        raise UsageError(f"`horizon`: {who} answers with chunks of {actions} actions, not {horizon}; set that")
