"""An honest client repeats a refused request as the server asks, beside hostile ones."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Trace
from s2a_bench.types import Piece, Request, Token
from tests.hostile.suite import honest_answer


class Refused:
    """A client whose server refuses some times."""

    camera = None

    def __init__(self, times: int, retry_after_s: float | None) -> None:
        self.times, self._retry_after_s = times, retry_after_s

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:  # noqa: ARG002 - any request
        if self.times:
            self.times -= 1
            raise RequestFailed("too many requests are under way", retry_after_s=self._retry_after_s)
        yield Token(0, "go")

    def describe(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        pass


def test_who_is_told_to_come_again_does() -> None:
    client = Refused(3, 0.01)
    assert honest_answer(client) == ["go"]
    assert client.times == 0


def test_who_is_not_does_not() -> None:
    client = Refused(3, None)
    with pytest.raises(RequestFailed, match="under way"):
        honest_answer(client)
    assert client.times == 2
