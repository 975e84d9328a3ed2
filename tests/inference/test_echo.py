from __future__ import annotations

from itertools import islice
from typing import Any

import pytest

from s2a_bench.boards.latency import read_latency, sequence_ns
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import UsageError
from s2a_bench.facts import LATENCY_DRAWN_MS
from s2a_bench.inference import Engine, EngineConfig, check_engine, open_engine
from s2a_bench.inference.echo import EchoEngine
from s2a_bench.testing.engine import EngineSuite, ask
from s2a_bench.types import Request

MS = 1_000_000
DRAWN = "lognormal:mean_ms=80,cv=.5"


class TestEcho(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return open_engine(EngineConfig(name="echo"))

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


class TestEchoWithLatency(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return echo(DRAWN)[0]

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


def echo(latency: str, **rest: Any) -> tuple[EchoEngine, VirtualClock]:
    clock = VirtualClock(10**12)
    return EchoEngine(EngineConfig(name="echo", latency=latency, **rest), clock), clock


def times_ns(engine: EchoEngine, clock: VirtualClock) -> list[int]:
    """Ask once and return when each piece came, from the request."""
    asked_ns = clock.now_ns()
    return [clock.now_ns() - asked_ns for _ in engine.generate(Request("r", "go", max_tokens=3))]


def known(written: str, count: int) -> list[int]:
    """Return what anybody can say beforehand."""
    latencies = read_latency(written)
    assert latencies is not None
    return list(islice(sequence_ns(latencies), count))


def test_echo_repeats_the_words_of_the_prompt_until_max_tokens() -> None:
    tokens = ask(EchoEngine(EngineConfig(name="echo")), "go  left", max_tokens=5)
    assert "".join(token.text for token in tokens) == "go left go left go"


def test_echo_answers_an_empty_prompt_with_its_name() -> None:
    assert [token.text for token in ask(EchoEngine(EngineConfig(name="echo")), "", max_tokens=2)] == ["echo", " echo"]


@pytest.mark.parametrize("answer", ["tokens", "actions"])
@pytest.mark.parametrize("written", ["80", DRAWN, "bursty:mean_ms=10,cv=0,burst_tokens=4,within=.1"])
def test_a_whole_answer_is_there_after_the_latency_of_its_request(written: str, answer: str) -> None:
    engine, clock = echo(written, answer=answer)
    assert [times_ns(engine, clock) for _ in range(20)] == [[each] * 3 for each in known(written, 20)]


def test_every_request_that_is_begun_takes_its_latency_also_where_the_rest_is_not_wanted() -> None:
    engine, clock = echo(DRAWN)
    engine.generate(Request("never begun", "go"))
    begun = engine.generate(Request("left", "go"))
    next(begun)
    begun.close()
    assert times_ns(engine, clock)[0] == known(DRAWN, 2)[1]


def test_each_answer_tells_its_latency() -> None:
    engine, clock = echo(DRAWN)
    for latency_ns in known(DRAWN, 3):
        times_ns(engine, clock)
        assert engine.facts == {LATENCY_DRAWN_MS: latency_ns / 1e6}


def test_an_echo_that_answers_at_once_tells_and_emulates_nothing() -> None:
    engine, clock = echo("")
    assert times_ns(engine, clock) == [0, 0, 0]
    assert (engine.facts, EchoEngine.facts_for(EngineConfig(name="echo"))) == ({}, ())
    assert "emulated" not in engine.describe()
    engine, _ = echo("80")
    assert (engine.describe()["emulated"], engine.describe()["latency"]) == (True, "80")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "llama", "latency": "80"}, "`latency` needs `engine` echo; `engine` llama answers at its own speed"),
        ({"name": "replay", "latency": "80"}, "`latency` needs `engine` echo"),
        ({"name": "echo", "latency": "80", "pace": 5}, "`pace`: with `latency` the whole answer arrives at once"),
        ({"name": "echo", "latency": "fast"}, "`latency`: 'fast' should be a number of ms, a family, or a .csv file"),
    ],
)
def test_a_latency_that_makes_no_sense_is_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        check_engine(EngineConfig(**options))
    assert message in str(error.value)


def test_a_number_is_as_good_as_its_text() -> None:
    assert EngineConfig(name="echo", latency=80) == EngineConfig(name="echo", latency="80")
