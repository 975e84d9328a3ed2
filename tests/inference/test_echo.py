import pytest

from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.inference.echo import EchoEngine
from s2a_bench.testing.engine import EngineSuite, ask


class TestEcho(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return open_engine(EngineConfig(name="echo"))

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


def test_echo_repeats_the_words_of_the_prompt_until_max_tokens() -> None:
    tokens = ask(EchoEngine(EngineConfig(name="echo")), "go  left", max_tokens=5)
    assert "".join(token.text for token in tokens) == "go left go left go"


def test_echo_answers_an_empty_prompt_with_its_name() -> None:
    assert [token.text for token in ask(EchoEngine(EngineConfig(name="echo")), "", max_tokens=2)] == ["echo", " echo"]
