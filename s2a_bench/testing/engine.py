"""The conformance suite of engines."""

from __future__ import annotations

import json

import numpy as np
import pytest

from s2a_bench.errors import EngineError
from s2a_bench.inference import Engine, declared_engine
from s2a_bench.types import Frame, Request, Token


def rgb_frame(seed: int = 0, width: int = 64, height: int = 48) -> Frame:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    return Frame(seed, 0, width, height, "rgb8", pixels)


def ask(
    engine: Engine, prompt: str = "stop at the red line", *, images: tuple[Frame, ...] = (), **rest: object
) -> list[Token]:
    return list(engine.generate(Request("r", prompt, images, **{"max_tokens": 6, **rest})))  # type: ignore[arg-type]


def texts(engine: Engine, prompt: str = "stop at the red line", **rest: object) -> list[str]:
    return [piece.text for piece in ask(engine, prompt, **rest)]  # type: ignore[arg-type]


class EngineSuite:
    """Fixtures: ``engine``, which may live as long as the class, and ``fresh_engine``, which one test closes."""

    def test_tokens_are_counted_from_0(self, engine: Engine) -> None:
        tokens = ask(engine)
        assert tokens
        assert [token.index for token in tokens] == list(range(len(tokens)))

    @pytest.mark.parametrize("max_tokens", [1, 2, 7])
    def test_at_most_max_tokens_come(self, engine: Engine, max_tokens: int) -> None:
        assert 1 <= len(ask(engine, max_tokens=max_tokens)) <= max_tokens

    def test_max_tokens_0_is_an_empty_answer(self, engine: Engine) -> None:
        assert ask(engine, max_tokens=0) == []

    def test_an_empty_prompt_is_answered(self, engine: Engine) -> None:
        assert ask(engine, "")

    def test_closing_early_leaves_the_next_answer_whole(self, engine: Engine) -> None:
        whole = texts(engine, seed=3)
        tokens = engine.generate(Request("early", "stop at the red line", max_tokens=6))
        next(tokens)
        tokens.close()  # type: ignore[attr-defined]
        assert texts(engine, seed=3) == whole

    def test_an_answer_never_asked_for_leaves_the_next_whole(self, engine: Engine) -> None:
        whole = texts(engine, seed=3)
        engine.generate(Request("unused", "go", max_tokens=6))
        assert texts(engine, seed=3) == whole

    def test_the_same_seed_gives_the_same_answer_with_other_requests_between(self, engine: Engine) -> None:
        first = texts(engine, seed=7, images=(rgb_frame(1),))
        ask(engine, "turn left", seed=8)
        ask(engine, seed=7, images=(rgb_frame(2),))
        assert texts(engine, seed=7, images=(rgb_frame(1),)) == first

    def test_a_prompt_may_carry_none_one_or_two_pictures(self, engine: Engine) -> None:
        for count in (0, 1, 2, 0):
            assert ask(engine, images=tuple(rgb_frame(index) for index in range(count)))

    def test_the_text_is_unicode_that_utf_8_can_carry(self, engine: Engine) -> None:
        text = "".join(token.text for token in ask(engine, "Größe 速度", max_tokens=40))
        assert text.encode().decode() == text

    def test_it_describes_itself_in_plain_json(self, engine: Engine) -> None:
        facts = engine.describe()
        assert json.loads(json.dumps(facts)) == facts
        assert isinstance(facts["engine"], str)
        assert isinstance(facts.get("dummy", False), bool)

    def test_every_fact_that_it_tells_is_declared(self, engine: Engine) -> None:
        ask(engine, images=(rgb_frame(),))
        facts = declared_engine(str(engine.describe()["engine"])).declared_facts
        assert set(engine.facts) <= set(facts)
        assert all(fact.about for fact in facts)

    def test_it_closes_twice_and_then_refuses_requests(self, fresh_engine: Engine) -> None:
        fresh_engine.close()
        fresh_engine.close()
        with pytest.raises(EngineError, match="closed"):
            ask(fresh_engine)
