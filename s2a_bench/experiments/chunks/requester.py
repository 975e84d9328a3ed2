"""Requests of a control loop: threads that measure them one after another, each with a client of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic
from typing import TYPE_CHECKING, Final, TypeAlias

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.harness.session import Measured, Place, RequestContext, Session
from s2a_bench.types import Action

if TYPE_CHECKING:
    from s2a_bench.types import Piece, Vector

OnActions: TypeAlias = "Callable[[int, Sequence[Vector], int], None]"
"""Called with a request's number, what has come of its chunk so far, and when, in ns."""

SEEDS: Final = 2**31
GRACE_S: Final = 1.0
"""For answers under way where a run ends before its time."""
MOST_WAIT_S: Final = 5.0
"""For a server that refused and asks to be left alone."""


@dataclass(frozen=True, slots=True)
class Job:
    """A request as the loop asks for it."""

    request: int
    tick: int
    state: tuple[float, ...]


@dataclass(slots=True)
class ChunkRequester:
    """Asks for chunks in the background; what was measured waits in ``done``.

    A request that fails before its chunk is whole is made again, as the robot goes on waiting for it; of the new answer
    only actions count that had not come.
    """

    sessions: Sequence[Session]
    horizon: int
    seed: int
    streams: bool
    heard: OnActions
    blocks: Iterator[int]
    """Gives each request its place in the run."""
    jobs: SimpleQueue[Job | None] = field(default_factory=SimpleQueue)
    done: SimpleQueue[tuple[Session, Measured]] = field(default_factory=SimpleQueue)
    names: dict[int, str] = field(default_factory=dict)
    """Request -> the id of its sample."""
    sent_bytes: int = 0
    """What the pictures weighed on the wire."""
    failure: BaseException | None = None
    over: Event = field(default_factory=Event)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Ask while the block runs, and until the last answers are there; but for `GRACE_S` where it raises."""
        threads = [
            Thread(target=self._work, args=(session,), name=f"requester-{place}", daemon=True)
            for place, session in enumerate(self.sessions)
        ]
        for thread in threads:
            thread.start()
        patience_s: float | None = GRACE_S
        try:
            yield
            patience_s = None  # a client that is in use is of no use to anybody else; its own limits end every answer
        finally:
            self.over.set()
            for _ in threads:
                self.jobs.put(None)
            until_s = monotonic() + GRACE_S
            for thread in threads:
                thread.join(None if patience_s is None else max(0, until_s - monotonic()))

    def _work(self, session: Session) -> None:
        try:
            while (job := self.jobs.get()) is not None and not self.over.is_set():
                self._ask(session, job)
        except BaseException as error:  # noqa: BLE001 - raised again where the loop is waited for
            self.failure = self.failure or error

    def _ask(self, session: Session, job: Job) -> None:
        """Ask until there is an answer, or nobody waits for one."""
        chunk: list[Vector] = []
        for attempt in count():
            actions: list[Vector] = []

            def heard(piece: Piece, at_ns: int, actions: list[Vector] = actions) -> None:
                if isinstance(piece, Action):
                    actions.append(piece.values)
                if len(actions) > len(chunk) and (self.streams or len(actions) == self.horizon):
                    chunk.extend(actions[len(chunk) :])
                    self.heard(job.request, chunk, at_ns)

            place = Place(next(self.blocks), attempt, warmup=False)
            request = replace(session.request, seed=(self.seed + job.tick) % SEEDS)
            measured = session.measure(place, RequestContext(job.state or None, heard, request=request))
            self.names[job.request] = measured.sample.request_id
            self.sent_bytes += measured.sample.payload_bytes or 0
            self.done.put((session, measured))
            if not measured.sample.error:
                check(session, len(actions), self.horizon)
            if not measured.sample.error or len(chunk) == self.horizon:
                return
            if measured.fatal is not None or self.over.wait(min(measured.retry_after_s, MOST_WAIT_S)):
                return


def warm_up(session: Session, place: Place, horizon: int) -> tuple[Measured, int]:
    """Ask once before the loop starts, and return of how many numbers an action is; raises as `check` does."""
    actions: list[Vector] = []

    def heard(piece: Piece, _at_ns: int) -> None:
        if isinstance(piece, Action):
            actions.append(piece.values)

    measured = session.measure(place, RequestContext(on_piece=heard))
    if not measured.sample.error:
        check(session, len(actions), horizon)
    return measured, actions[0].size if actions else 0


def check(session: Session, actions: int, horizon: int) -> None:
    """Raise UsageError for chunks that are not `horizon` long, RequestFailed for answers without actions."""
    cell = session.cell.name
    if not actions:
        raise RequestFailed(f"{cell} answers with tokens; acting needs a server that answers with chunks of actions")
    if actions != horizon:
        raise UsageError(f"`horizon`: {cell} answers with chunks of {actions} actions, not {horizon}; say so")
