"""The paced engine: another engine's answers at a set rate, on a virtual clock."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.inference import Engine, EngineConfig, PacedEngine, open_engine
from s2a_bench.inference.echo import EchoEngine
from s2a_bench.testing.engine import EngineSuite
from s2a_bench.types import Request, Token

SECOND = 10**9


class TestPacedEcho(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return PacedEngine(EchoEngine(EngineConfig(name="echo")), 10.0, VirtualClock())

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


class Slow:
    """Takes its time for each token, in s; keeps whether it was closed early."""

    facts: dict[str, float] = {"predicted_n": 3.0}  # noqa: RUF012 - nobody changes it

    def __init__(self, clock: VirtualClock, gaps_s: list[float]) -> None:
        self.clock, self.gaps_s, self.ended = clock, gaps_s, False

    def generate(self, request: Request) -> Iterator[Token]:
        del request
        try:
            for index, gap_s in enumerate(self.gaps_s):
                self.clock.sleep_until_ns(self.clock.now_ns() + round(gap_s * SECOND))
                yield Token(index, "x")
        finally:
            self.ended = True

    def describe(self) -> dict[str, str | int | float | bool]:
        return {"engine": "slow"}

    def close(self) -> None: ...


def times_s(gaps_s: list[float], rate: float) -> list[float]:
    clock = VirtualClock(SECOND)
    engine = PacedEngine(Slow(clock, gaps_s), rate, clock)
    return [clock.now_ns() / SECOND - 1 for _ in engine.generate(Request("r", ""))]


def test_tokens_come_at_the_rate_from_the_first_one_on() -> None:
    assert times_s([0.7, 0.01, 0.01, 0.01], 4.0) == pytest.approx([0.7, 0.95, 1.2, 1.45])


def test_a_late_token_goes_at_once_and_those_after_it_are_back_in_time() -> None:
    assert times_s([0.5, 0.6, 0.01, 0.01], 4.0) == pytest.approx([0.5, 1.1, 1.11, 1.25])


def test_a_slower_model_is_not_made_faster() -> None:
    assert times_s([1.0, 1.0, 1.0], 4.0) == [1.0, 2.0, 3.0]


def test_leaving_early_ends_the_engine_s_answer() -> None:
    clock = VirtualClock()
    slow = Slow(clock, [0.1] * 5)
    tokens = PacedEngine(slow, 5.0, clock).generate(Request("r", ""))
    next(tokens)
    tokens.close()  # type: ignore[attr-defined]
    assert slow.ended


def test_it_says_what_the_rate_is_and_else_what_the_engine_says() -> None:
    engine = open_engine(EngineConfig(name="echo", pace=4.8))
    plain = open_engine(EngineConfig(name="echo"))
    assert engine.describe() == {**plain.describe(), "paced_tokens_per_s": 4.8}
    assert PacedEngine(Slow(VirtualClock(), []), 1.0).facts == {"predicted_n": 3.0}
