"""An engine on one thread behaves as the engine itself, from any thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from s2a_bench.errors import EngineError
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.inference.echo import EchoEngine
from s2a_bench.inference.one_thread import AHEAD, Llama, OneThreadEngine
from s2a_bench.testing.engine import EngineSuite
from s2a_bench.types import Request, Token


class TestOneThread(EngineSuite):
    @pytest.fixture
    def engine(self) -> Iterator[Engine]:
        engine = OneThreadEngine(lambda: EchoEngine(EngineConfig(name="echo")))
        yield engine
        engine.close()

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


class Spy:
    """Remembers on which threads it was used."""

    def __init__(self, fails_at: int = -1) -> None:
        self.facts = {"prompt_n": 1.0}
        self.made = 0
        self.reached = threading.Event()
        self._fails_at = fails_at
        self.threads = [threading.get_ident()]
        self.closed_early = False

    def generate(self, request: Request) -> Iterator[Token]:
        try:
            for index in range(request.max_tokens):
                self.threads.append(threading.get_ident())
                if index == self._fails_at:
                    raise EngineError("enough")
                self.made += 1
                if self.made == 1 + AHEAD:
                    self.reached.set()
                yield Token(index, "x")
        except GeneratorExit:
            self.closed_early = True
            raise
        finally:
            self.threads.append(threading.get_ident())

    def describe(self) -> dict[str, str | int | float | bool]:
        self.threads.append(threading.get_ident())
        return {}

    def close(self) -> None:
        self.threads.append(threading.get_ident())


def test_all_work_is_done_on_one_thread_that_is_not_the_callers() -> None:
    spy = Spy()
    engine = OneThreadEngine(lambda: spy)
    spy.threads.clear()

    def use() -> None:
        list(engine.generate(Request("a", "b", max_tokens=2)))
        engine.describe()

    callers = [threading.Thread(target=use) for _ in range(3)]
    for caller in callers:
        caller.start()
        caller.join()
    engine.close()
    assert len(set(spy.threads)) == 1
    assert threading.get_ident() not in spy.threads
    assert engine.facts == {"prompt_n": 1.0}


def test_engines_that_take_turns_share_a_thread_which_ends_with_the_first(tiny: EngineConfig) -> None:
    first = Llama(tiny)
    second = open_engine(tiny.but(flash_attention="off"), first)
    assert (first.describe()["flash_attention"], second.describe()["flash_attention"]) == ("auto", "off")
    threads = [engine._submit(threading.get_ident).result() for engine in (first, second)]
    assert threads[0] == threads[1]
    for engine in (first, second, first):
        assert list(engine.generate(Request("a", "go", max_tokens=2)))
    second.close()
    assert list(first.generate(Request("b", "go", max_tokens=2)))
    first.close()
    assert threads[0] not in {thread.ident for thread in threading.enumerate()}


def test_leaving_early_cancels_the_engine() -> None:
    spy = Spy()
    engine = OneThreadEngine(lambda: spy)
    tokens = engine.generate(Request("a", "b", max_tokens=99))
    next(tokens)
    tokens.close()
    assert spy.closed_early
    assert spy.made <= 1 + AHEAD + 1
    engine.close()


def test_the_engine_computes_ahead_but_not_without_bound() -> None:
    spy = Spy()
    engine = OneThreadEngine(lambda: spy)
    tokens = engine.generate(Request("a", "b", max_tokens=99))
    first = next(tokens)
    spy.reached.wait(60)
    assert first.index == 0
    assert spy.made == 1 + AHEAD  # the place of the token that was read is free again
    assert [token.index for token in tokens] == list(range(1, 99))
    assert spy.made == 99
    engine.close()


def test_a_later_request_ends_an_earlier_one() -> None:
    engine = OneThreadEngine(Spy)
    early = engine.generate(Request("early", "b", max_tokens=99))
    next(early)
    assert len(list(engine.generate(Request("later", "b", max_tokens=5)))) == 5
    with pytest.raises(EngineError, match="one request at a time"):
        list(early)
    engine.close()


def test_closing_ends_an_answer_under_way() -> None:
    spy = Spy()
    engine = OneThreadEngine(lambda: spy)
    tokens = engine.generate(Request("a", "b", max_tokens=99))
    next(tokens)
    engine.close()
    assert spy.closed_early
    with pytest.raises(EngineError, match="closed before its answer was complete"):
        list(tokens)
    with pytest.raises(EngineError, match="closed"):
        next(engine.generate(Request("b", "b")))


def test_tokens_before_an_error_arrive_before_it() -> None:
    engine = OneThreadEngine(lambda: Spy(fails_at=3))
    tokens = engine.generate(Request("a", "b", max_tokens=9))
    assert [next(tokens).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(EngineError, match="enough"):
        next(tokens)
    engine.close()
