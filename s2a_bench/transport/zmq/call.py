"""One request to our policy server, from its bytes to its answer, on a thread.

Who must wait for the engine holds no thread: the call goes on when its turn comes, or to a refusal at its deadline.
Whoever goes on, or gives the request up, takes `_resumes` first; the other one finds it taken.
"""

from __future__ import annotations

import hmac
import logging
from collections import OrderedDict
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from threading import Event, Lock
from typing import Any, Final

from s2a_bench.clock import now_ns
from s2a_bench.errors import Busy, RequestFailed, S2AError
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import ours
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.turns import RETRY_AFTER_S, STUCK_S, Queued, Turn, whole
from s2a_bench.transport.zmq import layouts, own
from s2a_bench.transport.zmq.watch import Connection
from s2a_bench.transport.zmq.wire import pack, unpack
from s2a_bench.types import Piece, Request

THREADS: Final = 8
"""One answers; the others read what comes meanwhile."""
KEPT: Final = 128
"""Requests whose marks are kept until they are asked for, the latest; those of a long answer are half a megabyte."""


ASKED_S: Final = 0.005
"""How long marks wait to be found for somebody who asks for them."""
UNKNOWN: Final = RequestFailed("marks of a request that is not known, or whose marks were asked for already")


class _Gone(Exception):
    """Nobody wants the answer any more."""


class Office:
    """What all calls of a server share."""

    def __init__(
        self, queued: Queued, limits: Limits, key: str, layout: str, send: Callable[[list[Any]], None]
    ) -> None:
        """Answer with ``queued`` who has the ``key``; ``send`` takes the frames of an answer from any thread."""
        self.queued, self.limits, self.send = queued, limits, send
        self.threads = ThreadPoolExecutor(THREADS, "zmq")
        self.calls: set[Call] = set()
        self._key, self._layout = key.encode(), layout
        self._lock = Lock()
        self._marks: OrderedDict[tuple[bytes, str], Promise] = OrderedDict()

    @property
    def in_flight(self) -> int:
        """Return the bytes of all requests that are not answered yet."""
        return sum(call.size for call in list(self.calls))

    def refuse_more(self, size: int) -> None:
        """Raise Busy where there is no room for one more request of ``size`` bytes."""
        if len(self.calls) > self.limits.waiting + 2 * THREADS or self.in_flight + size > self.limits.in_flight_bytes:
            raise Busy("too many requests are under way; come again later", retry_after_s=RETRY_AFTER_S)

    def check_key(self, message: dict[Any, Any]) -> None:
        """Raise RequestFailed for a message without the key, compared in constant time."""
        said = message.get(own.TOKEN)
        token = said.encode(errors="replace") if isinstance(said, str) else b""
        if self._key and not hmac.compare_digest(token, self._key):
            raise RequestFailed(f"Unauthorized: this server wants its key as {own.TOKEN}")

    def told(self, endpoint: Any) -> Any:
        """Return the answer of an endpoint that asks for no action."""
        if endpoint == own.PING:
            silent_s = self.queued.turns.silent_s()
            if silent_s > STUCK_S:
                raise RequestFailed(f"the answer under way has shown no sign of life for {silent_s:.0f} s")
            return {"status": "ok", "message": "Server is running"}
        if endpoint == own.MODALITIES:
            return layouts.modalities(self._layout)
        if endpoint == own.RESET:
            return {}
        if endpoint == own.KILL:
            raise RequestFailed("this server is not ended over the network: stop its process")
        known = f"{own.GET_ACTION}, {own.PING}, {own.RESET}, {own.MODALITIES}"
        raise RequestFailed(f"Unknown endpoint: {str(endpoint)[:80]!r} is none of {known}")

    def promise(self, who: bytes, request_id: str) -> Promise:
        """Remember that somebody will ask for a request's marks."""
        promised = Promise()
        with self._lock:
            lost = [self._marks.pop((who, request_id), None)]
            self._marks[who, request_id] = promised
            if len(self._marks) > KEPT:
                lost.append(self._marks.popitem(last=False)[1])
        for each in lost:
            if each is not None and each.call is not None:
                each.call.refuse(UNKNOWN)
        return promised

    def keep(self, who: bytes, request_id: str, promised: Promise, marks: bytes) -> None:
        """Hand marks to who has asked for them, or keep them."""
        with self._lock:
            promised.marks, call = marks, promised.call
            if call is None or self._marks.get((who, request_id)) is not promised:
                return
            del self._marks[who, request_id]
        call.say(marks)

    def ask(self, who: bytes, request_id: str, call: Call) -> None:
        """Answer a call with marks, or let it wait for them; raises RequestFailed for a request that nobody knows."""
        with self._lock:
            promised = self._marks.get((who, request_id))
            if promised is None or promised.call is not None:
                raise UNKNOWN
            marks = promised.marks
            if marks is None:
                promised.call = call
                promised.asked.set()
                return
            del self._marks[who, request_id]
        call.say(marks)


class Promise:
    """The marks of a request, once they are found, and who has asked for them."""

    __slots__ = ("asked", "call", "marks")

    def __init__(self) -> None:
        """Promise marks that are still to be found."""
        self.asked = Event()
        self.call: Call | None = None
        self.marks: bytes | None = None


class Call:
    """One request whose bytes are there."""

    def __init__(self, office: Office, envelope: Sequence[bytes], connection: Connection, size: int) -> None:
        """Answer to ``envelope``, the frames before a message, as long as the connection is there."""
        self.size = size
        """Bytes that it holds."""
        self._office, self._envelope, self._connection = office, envelope, connection
        self._turn: Turn | None = None
        self._goes_on: Callable[[], None] | None = None
        self._resumes = Lock()
        office.calls.add(self)

    def start(self, message: Any, trace: Trace) -> None:
        """Read the request on a thread, and answer if nobody is before us."""
        self._submit(self._read, message, trace)

    def look(self, at_ns: int) -> None:
        """Give up what waits for the engine where its client has gone, or its time is over."""
        turn, goes_on = self._turn, self._goes_on
        if turn is None or goes_on is None or turn.come is None:
            return
        if self._connection.gone and self._resumes.acquire(blocking=False):
            turn.leave()
            self._office.calls.discard(self)
        elif at_ns > turn.deadline_ns:
            goes_on()

    def say(self, message: bytes | memoryview) -> None:
        """Answer, and be over."""
        self._office.calls.discard(self)
        self._office.send([*self._envelope, message])

    def refuse(self, error: S2AError) -> None:
        """Answer with an error."""
        retry_s = error.retry_after_s if isinstance(error, RequestFailed) else None
        told = {own.ERROR: str(error) or type(error).__name__}
        self.say(pack({**told, own.RETRY: retry_s} if retry_s else told))

    def _submit(self, does: Callable[..., None], *told: Any) -> None:
        with suppress(RuntimeError):  # the server has ended
            self._office.threads.submit(self._guarded, does, *told)

    def _guarded(self, does: Callable[..., None], *told: Any) -> None:
        """Do a step; whatever goes wrong in it is told to who asked, in a line."""
        try:
            does(*told)
        except S2AError as error:
            self._leave()
            self.refuse(error)
        except _Gone:
            self._leave()
            self._office.calls.discard(self)
        except Exception:
            logging.getLogger(__name__).exception("a request failed")
            self._leave()
            self.refuse(RequestFailed("internal error; the server's log has it"))

    def _leave(self) -> None:
        if self._turn is not None:
            self._turn.leave()

    def _read(self, frame: Any, trace: Trace) -> None:
        message = unpack(frame)
        trace.mark("msgpack_parse")
        if not isinstance(message, dict):
            raise RequestFailed(f"a request is a map, not {type(message).__name__}")
        office = self._office
        office.check_key(message)
        endpoint, told = message.get(own.ENDPOINT, own.GET_ACTION), ours.told_in(message)
        if endpoint == own.MARKS and told is not None:
            office.ask(self._envelope[0], str(told.get("id")), self)
            return
        if endpoint != own.GET_ACTION:
            self.say(pack(office.told(endpoint)))
            return
        observation, layout = layouts.observation_in(message.get(own.DATA))
        request = ours.request_of(observation, told, trace, office.limits)
        trace.mark("msgpack_parse")
        turn = self._turn = office.queued.turns.join()

        def answer() -> None:
            self._answer(request, trace, turn, lambda pieces: layouts.answer_of(observation, layout, pieces), told)

        if turn.come is None:
            answer()
            return
        trace.mark(RESIDUAL)

        def go_on() -> None:
            turn.check(now_ns())
            trace.mark("queue")
            answer()

        def resume() -> None:
            if self._resumes.acquire(blocking=False):
                self._submit(go_on)

        self._goes_on = resume
        turn.come.add_done_callback(lambda _: resume())

    def _answer(
        self,
        request: Request,
        trace: Trace,
        turn: Turn,
        form: Callable[[Sequence[Piece]], Any],
        told: dict[Any, Any] | None,
    ) -> None:
        """Send the chunk, then find the marks, which may take time, for our own client."""
        pieces = whole(self._wanted(self._office.queued.answer(request, trace, turn)), trace)
        answer = pack(form(pieces))
        who = self._envelope[0]
        promised = None if told is None else self._office.promise(who, request.id)
        self.say(answer)
        if promised is not None:
            promised.asked.wait(ASKED_S)  # or the answer's way would be slower for what is computed now
            marks = bytes(pack(ours.remote_message(trace.to_remote())))
            self._office.keep(who, request.id, promised, marks)

    def _wanted(self, pieces: Generator[Piece, None, None]) -> Generator[Piece, None, None]:
        """Yield the pieces for as long as somebody wants them."""
        with closing(pieces):
            for piece in pieces:
                if self._connection.gone:
                    raise _Gone
                yield piece
