"""The exchanges of a ROS server: the newest camera frame, counts, and the order in which answers end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from threading import Event
from typing import Final

from s2a_bench.errors import S2AError
from s2a_bench.trace import Trace
from s2a_bench.transport.ros.camera import CameraCache
from s2a_bench.transport.ros.node import Activity
from s2a_bench.transport.serving import CLOCK_PROMPT, Exchange
from s2a_bench.types import Piece, Request

END_S: Final = 5.0
"""The longest that an answer's end waits for that of the answer before."""
OVER: Final = Event()
"""The end of an answer that was not begun; making an event for each request takes 9 us."""
OVER.set()


@dataclass(slots=True)
class Shared:
    cache: CameraCache
    activity: Activity
    stopped: Event = field(default_factory=Event)
    ended: Event = field(default_factory=Event)
    """Set when the end of the last answer that was begun has been sent."""

    def __post_init__(self) -> None:
        self.ended.set()


class RosExchange(Exchange):
    """One request of a front; subclasses read it, send its pieces and finish it."""

    parse_stage = "cdr_parse"

    def __init__(self, shared: Shared, trace: Trace) -> None:
        super().__init__(trace)
        self._shared = shared
        self._before = self._ended = OVER

    def cancelled(self) -> bool:
        """Whether the client wants no answer any more; a topic cannot tell."""
        return False

    def started(self) -> bool:
        """Tell the client that its turn has come; return whether it still wants the answer."""
        return True

    def piece(self, piece: Piece) -> bool:
        """Send a piece; return whether more are wanted."""
        raise NotImplementedError

    def finish(self, error: str) -> None:
        """Send the end of the answer, with an ``error`` if something failed."""
        raise NotImplementedError

    def disconnected(self) -> bool:
        return self._shared.stopped.is_set() or self.cancelled()

    def abandon(self) -> None:
        """End a goal that was cancelled, and what waits when the server is stopped."""

    def begin(self, request: Request) -> Request | None:
        """Add the newest frame to a request without a picture; raises RequestFailed where none arrives."""
        shared = self._shared
        shared.activity.requests += 1
        self._before, shared.ended = shared.ended, Event()  # in its turn, so one thread at a time
        self._ended = shared.ended
        if not self.started():
            return None
        if request.images or request.prompt.startswith(CLOCK_PROMPT):
            return request
        return replace(request, images=shared.cache.newest(self.trace))

    def send(self, piece: Piece) -> bool:
        self._shared.activity.tokens += 1
        return not self._shared.stopped.is_set() and self.piece(piece)

    def end(self) -> None:
        self._over("the server is stopping" if self._shared.stopped.is_set() else "")

    def fail(self, error: S2AError) -> None:
        self._shared.activity.failed(str(error))
        self._over(str(error))

    def _over(self, error: str) -> None:
        """Finish after the answer before, so that clients see ends in the order of the answers."""
        self._before.wait(END_S)
        try:
            self.finish(error)
        finally:
            self._ended.set()
