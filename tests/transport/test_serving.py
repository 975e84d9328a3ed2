"""The server core: the calls of an exchange and their order, for every transport."""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Event, Thread

import pytest

from s2a_bench.errors import S2AError
from s2a_bench.testing.transport import RecordingHandler
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.serving import Core, Disconnected, Exchange, SharedSourceWorkers
from s2a_bench.types import Piece, Request


class Told(Exchange):
    """Has bytes in flight, and notes how many are left when it ends; may break in a call."""

    def __init__(self, core: Core, breaks: str = "") -> None:
        super().__init__()
        self.trace.mark("network")
        self.held.enter_context(core.in_flight.counted())(1000)
        self.held_at_end = -1
        self._core, self._breaks = core, breaks

    def request(self) -> Request:
        return Request("a", "go on")

    def disconnected(self) -> bool:
        return False

    def send(self, _piece: Piece) -> bool:
        if self._breaks == "send":
            raise Disconnected
        return True

    def end(self) -> None:
        self.held_at_end = self._core.in_flight.bytes
        if self._breaks == "end":
            raise Disconnected

    def fail(self, error: S2AError) -> None:
        raise AssertionError from error


@pytest.fixture
def core() -> Core:
    return Core(RecordingHandler(["go", "on"]), Limits())


def test_its_bytes_are_given_back_before_the_end_which_may_wait_for_a_slow_client(core: Core) -> None:
    exchange = Told(core)
    assert core.in_flight.bytes == 1000
    core.answer(exchange)
    assert (exchange.held_at_end, core.in_flight.bytes) == (0, 0)


@pytest.mark.parametrize("breaks", ["send", "end"])
def test_where_the_client_cannot_be_told_the_connection_is_to_be_closed(core: Core, breaks: str) -> None:
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
