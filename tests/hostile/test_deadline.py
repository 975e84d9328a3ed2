"""An answer that is slow but alive ends at its deadline with one clear error, and the engine is free afterwards."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing

import httpx
import pytest

from s2a_bench.errors import BadRequest, RequestFailed
from s2a_bench.harness.serving import engine_handler
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.transport.limits import Limits
from s2a_bench.types import Request, Token
from tests.hostile.test_queue import body, serving

SOON = Limits(answer_s=1.0)
REASON = "1 s after its arrival the request is still being answered"


class Endless:
    """An engine whose answer to "for ever" does not end, and that cannot read a grammar."""

    def __init__(self) -> None:
        self.facts: dict[str, float] = {}
        self.closed = 0

    def generate(self, request: Request) -> Iterator[Token]:
        if request.grammar:
            raise BadRequest(f"the grammar of request {request.id} is not valid GBNF: it is none")
        try:
            for index in range(10**6 if request.prompt == "for ever" else 2):
                yield Token(index, "a")
                time.sleep(0.01)
        finally:
            self.closed += 1

    def describe(self) -> dict[str, str | int | float | bool]:
        return {}

    def close(self) -> None:
        pass


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
def test_an_answer_that_is_not_streamed_is_504(variant: str) -> None:
    with serving(engine_handler(Endless(), limits=SOON), f"http/{variant}", SOON) as url:
        answer = httpx.post(url + PATHS[variant], json=body("for ever", stream=False, max_tokens=60_000), timeout=30)
        assert answer.status_code == 504
        assert REASON in answer.json()["error"]["message"]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        *((f"http/{variant}", "answered 400: .*not valid GBNF") for variant in PATHS),
        ("ros/topic", "not valid GBNF"),
        ("ros/action", "not valid GBNF"),
    ],
)
def test_a_grammar_that_is_none_is_the_client_s_mistake(name: str, says: str) -> None:
    with serving(engine_handler(Endless()), name) as address, closing(open_client(wiring_of(name, address))) as client:
        with pytest.raises(RequestFailed, match=says):
            ask(client, Request("a", "a", grammar="x"))
        assert len(ask(client, Request("b", "a", max_tokens=2))[0]) == 2
