"""One request to our policy server, from its bytes to the last frame of its answer, on a thread.

Who must wait for the engine holds no thread: the call goes on when its turn comes, or to a refusal at its deadline.
Whoever goes on, or gives the request up, takes `_resumes` first; the other one finds it taken.
"""

from __future__ import annotations

import logging
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from threading import Lock
from typing import Any, Final, Protocol

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import EngineError, S2AError
from s2a_bench.facts import INFER_MS
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import ours
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.turns import Queued, Turn, whole
from s2a_bench.transport.websocket import PREV_TOTAL_MS, own
from s2a_bench.transport.websocket.codec import packb, unpackb
from s2a_bench.types import Action, Piece, Request

THREADS: Final = 8
"""One answers; the others read what comes meanwhile."""


class Peer(Protocol):
    """Who asked: a connection, as far as a call knows it; all of it may be called from any thread."""

    ours: bool
    """Whether it is our client, which is told our marks."""
    streams: bool
    previous_ms: float | None
    """What the request before took."""

    def write(self, message: bytes | str) -> None:
        """Send a message: bytes, or the text of an error."""
        ...

    def answered(self, error: str) -> None:
        """Take the next request, or after an error close."""
        ...


class _Gone(Exception):
    """Nobody wants the answer any more."""


class Office:
    """What all calls of a server share."""

    def __init__(self, queued: Queued, limits: Limits) -> None:
        """Answer with ``queued``."""
        self.queued, self.limits = queued, limits
        self.threads = ThreadPoolExecutor(THREADS, "websocket")


class Call:
    """One request whose bytes are there."""

    def __init__(self, office: Office, loop: AbstractEventLoop, peer: Peer) -> None:
        """Answer ``peer``; `leave` and timers are the loop's, all else is a thread's."""
        self._office, self._loop, self._peer = office, loop, peer
        self._turn: Turn | None = None
        self._resumes = Lock()
        self._late: TimerHandle | None = None
        self._gone = False

    def start(self, message: bytes, trace: Trace) -> None:
        """Read the request on a thread, and answer if nobody is before us."""
        self._began_ns = trace.marks[0][1]
        self._office.threads.submit(self._guarded, self._read, message, trace)

    def leave(self) -> None:
        """Take note that the client has gone: an answer under way ends at its next action."""
        self._gone = True
        if self._late is not None:
            self._late.cancel()
        turn = self._turn
        if turn is not None and turn.come is not None and self._resumes.acquire(blocking=False):
            turn.leave()
            self._peer.answered("")

    def _guarded(self, does: Callable[..., None], *told: Any) -> None:
        """Do a step; whatever goes wrong in it is told to who asked, in a line."""
        said = ""
        try:
            does(*told)
        except _Gone:
            pass
        except S2AError as error:
            said = str(error) or type(error).__name__
        except Exception:
            logging.getLogger(__name__).exception("a request failed")
            said = "internal error; the server's log has it"
        else:
            return
        if self._turn is not None:
            self._turn.leave()
        self._peer.answered(said)

    def _read(self, message: bytes, trace: Trace) -> None:
        if self._gone:
            raise _Gone
        observation = unpackb(message)
        trace.mark("msgpack_parse")
        told = ours.told_in(observation) if self._peer.ours else None
        request = ours.request_of(observation, told, trace, self._office.limits)
        trace.mark("msgpack_parse")
        turn = self._turn = self._office.queued.turns.join()
        if turn.come is None:
            self._answer(request, trace, turn)
            return
        trace.mark(RESIDUAL)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._wait, request, trace, turn)

    def _wait(self, request: Request, trace: Trace, turn: Turn) -> None:
        """Go on when the turn comes, or at the deadline."""
        if self._gone:
            self.leave()
            return

        def resume() -> None:
            if self._resumes.acquire(blocking=False):
                with suppress(RuntimeError):  # the server has ended
                    self._office.threads.submit(self._guarded, self._go_on, request, trace, turn)

        def give_up() -> None:  # timers may be early
            if left_s := turn.left_s():
                self._late = self._loop.call_later(left_s, give_up)
            else:
                resume()

        give_up()
        if turn.come is not None:
            turn.come.add_done_callback(lambda _: resume())

    def _go_on(self, request: Request, trace: Trace, turn: Turn) -> None:
        if self._late is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._late.cancel)
        turn.check(now_ns())
        trace.mark("queue")
        self._answer(request, trace, turn)

    def _answer(self, request: Request, trace: Trace, turn: Turn) -> None:
        """Send the actions, then to our own client the marks, which may take time to find."""
        started_ns = now_ns()
        pieces = self._wanted(self._office.queued.answer(request, trace, turn))
        if self._peer.streams:
            actions = []
            for piece in pieces:
                actions.append(_values(piece))
                partial = {own.TYPE: own.PARTIAL, own.ACTIONS: actions[-1][None]}
                partial[own.INDICES] = np.array([len(actions) - 1])
                self._peer.write(packb(partial))
        else:
            actions = [_values(piece) for piece in whole(pieces, trace)]
        if not actions:
            raise EngineError("the engine answered with no action at all")
        ended_ns = trace.token_ns[-1] if trace.token_ns else now_ns()
        timing = {str(INFER_MS): (ended_ns - started_ns) / 1e6}
        if self._peer.previous_ms is not None:
            timing[str(PREV_TOTAL_MS)] = self._peer.previous_ms
        kind = {own.TYPE: own.FINAL} if self._peer.streams else {}
        self._peer.write(packb({**kind, own.ACTIONS: np.stack(actions), own.TIMING: timing}))
        self._peer.previous_ms = (now_ns() - self._began_ns) / 1e6
        if self._peer.ours:
            self._peer.write(packb(ours.remote_message(trace.to_remote())))
        self._peer.answered("")

    def _wanted(self, pieces: Generator[Piece, None, None]) -> Generator[Piece, None, None]:
        """Yield the pieces for as long as somebody wants them."""
        with closing(pieces):
            for piece in pieces:
                if self._gone:
                    raise _Gone
                yield piece


def _values(piece: Piece) -> Any:
    if not isinstance(piece, Action):
        raise EngineError("the engine answers with tokens, and this protocol knows actions; choose `answer` actions")
    return piece.values


def metadata_of(queued: Queued) -> Mapping[str, Any]:
    """Return what a server says of itself to everybody who connects."""
    settings = queued.settings.model_dump() if queued.settings is not None else {}
    names = {"name": "engine", "horizon": "action_horizon", "action_dim": "action_dim"}
    told = {said: settings[name] for name, said in names.items() if isinstance(settings.get(name), (str, int))}
    return {"server": "s2a-bench", **told, "provenance": queued.provenance}
