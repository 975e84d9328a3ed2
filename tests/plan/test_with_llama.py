from collections.abc import Iterator

import pytest

from s2a_bench.inference import EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.plan import (
    GRANULARITIES,
    Parser,
    SkillParsed,
    SkillSet,
    choose_format,
    grammar,
    prompt,
)
from s2a_bench.types import Request, Token


@pytest.fixture(scope="module")
def engine(tiny: EngineConfig) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(tiny)
    yield engine
    engine.close()


def tokens(engine: LlamaCppEngine, text: str, gbnf: str, seed: int, most: int = 300) -> Iterator[Token]:
    return engine.generate(Request("r", text, max_tokens=most, grammar=gbnf, seed=seed))


@pytest.mark.parametrize("size", GRANULARITIES)
@pytest.mark.parametrize("pinned", [False, True])
def test_a_model_under_the_grammar_writes_n_skills_of_l_tokens(
    engine: LlamaCppEngine, of_bytes: Tokenizer, skills: SkillSet, size: int, pinned: bool
) -> None:
    format_ = choose_format(skills, size, of_bytes)
    gbnf = grammar(format_, 8, of_bytes if pinned else None)
    for seed in range(2):
        parser = Parser(format_)
        events = []
        for count, token in enumerate(tokens(engine, prompt(format_, 8, "Go."), gbnf, seed)):
            found = parser.feed(token.text)
            assert bool(found) == ((count + 1) % size == 0)
            events += found
        assert parser.close() == []
        assert all(isinstance(event, SkillParsed) for event in events)
        assert [event.piece for event in events] == [size * at - 1 for at in range(1, 9)]
