"""The server core: the calls of an exchange and their order, for every transport."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from threading import Event, Thread

import pytest

from s2a_bench.errors import S2AError
from s2a_bench.trace import Trace
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import Core, Disconnected, Exchange, SharedSourceWorkers
from s2a_bench.types import Piece, Request, Token


class Told(Exchange):
    """Records its calls."""

    def __init__(self, core: Core, *, has_gone: bool = False, breaks: str = "") -> None:
        super().__init__()
        self.trace.mark("network")
        self.calls: list[str] = []
        self.held.enter_context(core.in_flight.counted())(1000)
        self.held_at_end = -1
        self._core, self._has_gone, self._breaks = core, has_gone, breaks

    def request(self) -> Request:
        self.calls.append("request")
        return Request("a", "go on")

    def accept(self) -> None:
        self.calls.append("accept")

    def disconnected(self) -> bool:
        return self._has_gone

    def send(self, piece: Piece) -> bool:
        self.calls.append(piece.text)
        if self._breaks == "send":
            raise Disconnected
        return True

    def end(self) -> None:
        self.held_at_end = self._core.in_flight.bytes
        self.calls.append("end")
        if self._breaks == "end":
            raise Disconnected

    def fail(self, error: S2AError) -> None:
        self.calls.append(str(error))


def words(request: Request, trace: Trace) -> Generator[Piece, None, None]:
    del request, trace
    for index, text in enumerate(("go", "on")):
        yield Token(index, text, -1)


def core_of(handler: Callable[[Request, Trace], Generator[Piece, None, None]] = words) -> Core:
    return Core(handler, Limits())


def test_its_bytes_are_given_back_before_the_end_which_may_wait_for_a_slow_client() -> None:
    core = core_of()
    exchange = Told(core)
    assert core.in_flight.bytes == 1000
    core.answer(exchange)
    assert (exchange.held_at_end, core.in_flight.bytes) == (0, 0)


@pytest.mark.parametrize("breaks", ["send", "end"])
def test_where_the_client_cannot_be_told_the_connection_is_to_be_closed(breaks: str) -> None:
    core = core_of()
    assert not core.answer(Told(core, breaks=breaks))
    assert core.answer(Told(core))  # the engine is free
    assert core.in_flight.bytes == 0


def test_a_worker_without_another_thread_answers_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answered, stopped = Event(), Event()
    pending = [answered.set]

    def take() -> Callable[[], None] | None:
        stopped.wait(0.01)
        return pending.pop() if pending else None

    workers = SharedSourceWorkers(take, stopped)
    start = Thread.start
    started: list[Thread] = []

    def limited(thread: Thread) -> None:
        if thread.name == "worker" and len(started) >= 1:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(Thread, "start", limited)
    monkeypatch.setattr("s2a_bench.transport.serving.IDLE_WORKERS", 1)
    with caplog.at_level(logging.WARNING):
        workers.start()
        assert answered.wait(10)
        stopped.set()
        workers.join()
    assert "no thread for the next request" in caplog.text
