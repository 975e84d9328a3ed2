"""Hostile peers of our ROS clients: nodes that look like our server."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from threading import Event, Thread
from typing import Any, TypeAlias

from s2a_bench.errors import TransportError
from s2a_bench.ros import Middleware, ServerGoal
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE, text_result, token_feedback
from s2a_bench.ros.service import READER_QOS
from s2a_bench.transport import Wiring
from s2a_bench.transport.ros.action import ACTION, MARKS
from s2a_bench.transport.ros.camera import POLL_S
from s2a_bench.transport.ros.joining import AT, join, settled
from s2a_bench.transport.ros.wire import TOKEN_QOS, token_message
from s2a_bench.types import Token
from tests.hostile.suite import FAILED, Case, Trap
from tests.hostile.tcp import NOISE
from tests.hostile.wires.http import CONTROL
from tests.hostile.wires.ros import CDR

_numbers = count()


@contextmanager
def _running(middleware: Middleware, over: Event, end: Any, run: Callable[[], None]) -> Iterator[None]:
    """Run on a thread of its own for as long as the context lasts."""
    thread = Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        with suppress(Exception):  # it may have left already, and Cyclone raises what it likes then
            end.interrupt()
        thread.join()
        middleware.close()


Reply: TypeAlias = "Callable[[str, Event], Iterable[bytes | bytearray | None]]"
"""What a hostile server publishes on /token to a request of this id, until the event is set; None: it leaves."""


def tokens(reply: Reply) -> Trap:
    """Return a server of the topic variant."""

    @contextmanager
    def trap(wiring: Wiring[Any]) -> Iterator[str]:
        namespace, over = f"/hostile_{next(_numbers)}", Event()
        wiring, host = settled(wiring)
        middleware = join(wiring, "server", host=host)
        requests = middleware.subscription(namespace + "/request", ros.REQUEST, READER_QOS)
        publisher = middleware.publisher(namespace + "/token", ros.TOKEN, TOKEN_QOS)

        def run() -> None:
            while not over.is_set():
                if (packed := requests.take(POLL_S)) is not None:
                    for piece in reply(requests.unpack(packed).id, over):
                        if piece is None:
                            middleware.close()
                            return
                        with suppress(TransportError):  # it has left
                            publisher.send(bytearray(piece))

        with _running(middleware, over, requests, run):
            yield namespace + "".join(wiring.address.partition(AT)[1:])

    return trap


def _token(request_id: str, index: int, text: str = "go", **more: Any) -> bytearray:
    message = token_message(request_id, Token(index, text, -1), **{"last": False, **more})
    return ros.serialise(message, ros.TOKEN)


def _endless(request_id: str, over: Event) -> Iterator[bytearray]:
    index = 0
    while not over.is_set():
        yield _token(request_id, index)
        index += 1


TOKENS: tuple[Case[Trap], ...] = (
    Case("silence", tokens(lambda _id, _over: ()), "^RequestFailed: no token for 2 s"),
    Case("noise as tokens", tokens(lambda _id, _over: [CDR + NOISE[:400]] * 9), FAILED),
    Case("a text of 1 GiB announced", tokens(lambda _id, _over: [CDR + struct.pack("<I", 1 << 30)] * 9), FAILED),
    Case(
        "tokens of somebody else",
        tokens(lambda _id, _over: [_token("other", n) for n in range(99)]),
        "^RequestFailed: no token",
    ),
    Case("one token, then silence", tokens(lambda name, _over: [_token(name, 0)]), "^RequestFailed: no token"),
    Case("one token, then gone", tokens(lambda name, _over: [_token(name, 0), None]), FAILED),
    Case("tokens that are lost", tokens(lambda name, _over: [_token(name, 0), _token(name, 2)]), "^MessagesLost: "),
    Case("every token twice", tokens(lambda name, _over: [_token(name, n // 2) for n in range(8)]), "^MessagesLost: "),
    Case("a token of 16 MiB, then silence", tokens(lambda name, _over: [_token(name, 0, "a" * (16 << 20))]), FAILED),
    Case("an error", tokens(lambda name, _over: [_token(name, 0, "", last=True, error="no")]), "^RequestFailed: .*no$"),
    Case(
        "an error that forges lines",
        tokens(lambda name, _over: [_token(name, 0, "", last=True, error=CONTROL.replace("\0", ""))]),
        FAILED,
    ),
    Case("endless tokens", tokens(_endless), FAILED),
)


def goals(answer: Callable[[ServerGoal, Event, Callable[[], None]], None]) -> Trap:
    """Return a server of the action variant; what answers a goal may also leave."""

    @contextmanager
    def trap(wiring: Wiring[Any]) -> Iterator[str]:
        namespace, over = f"/hostile_{next(_numbers)}", Event()
        wiring, host = settled(wiring)
        middleware = join(wiring, "server", host=host)
        server = middleware.action_server(namespace + ACTION, GENERATE_RESPONSE)
        kept = middleware.publisher(namespace + MARKS, ros.MARKS, TOKEN_QOS)

        def run() -> None:
            while not over.is_set():
                if (goal := server.next_goal(POLL_S)) is not None:
                    with suppress(TransportError):  # it was cancelled, or we have left
                        answer(goal, over, middleware.close)

        with _running(middleware, over, server, run):
            yield namespace + "".join(wiring.address.partition(AT)[1:])
        del kept  # the client waits until it has matched it

    return trap


def _starts(goal: ServerGoal, *texts: str) -> None:
    goal.accept()
    goal.executing()
    for text in texts:
        goal.feedback(token_feedback(text, 0))


def _lies(goal: ServerGoal, *_: Any) -> None:
    _starts(goal, "go")
    goal.succeed(text_result("something else"))


def _aborts(goal: ServerGoal, *_: Any) -> None:
    _starts(goal, "go")
    goal.abort(text_result("had enough"))


def _forges(goal: ServerGoal, *_: Any) -> None:
    _starts(goal, "go")
    goal.abort(text_result(CONTROL.replace("\0", "")))


def _goes_on(goal: ServerGoal, over: Event, _: Callable[[], None]) -> None:
    _starts(goal)
    while not (over.is_set() or goal.cancel_requested):
        goal.feedback(token_feedback("go", 0))


def _leaves(goal: ServerGoal, _: Event, leave: Callable[[], None]) -> None:
    _starts(goal, "go")
    leave()


GOALS: tuple[Case[Trap], ...] = (
    Case("silence", goals(lambda *_: None), FAILED),
    Case("every goal rejected", goals(lambda goal, *_: goal.reject()), "^RequestFailed: the server rejected the goal"),
    Case("accepted, then silence", goals(lambda goal, *_: goal.accept()), "^RequestFailed: no feedback for 2 s"),
    Case("one token, then silence", goals(lambda goal, *_: _starts(goal, "go")), "^RequestFailed: no feedback for 2 s"),
    Case("one token, then gone", goals(_leaves), "^ServerDied: .*has ended"),
    Case("another answer than its tokens", goals(_lies), "^MessagesLost: "),
    Case("aborted", goals(_aborts), "^RequestFailed: .*had enough"),
    Case("aborted with words that forge lines", goals(_forges), "^RequestFailed: .*all is well"),
    Case("endless tokens", goals(_goes_on), FAILED),
)
