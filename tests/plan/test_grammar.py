import random
from collections.abc import Iterator

import pytest

from benchmarks.plan_text import text_of
from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.llama_decode import grammar_error
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.plan import (
    Format,
    Parser,
    SkillParsed,
    SkillSet,
    Tokenize,
    choose_format,
    grammar,
    load_skills,
    paper_format,
    parse_skills,
    prompt,
)
from s2a_bench.types import Request
from tests.plan.conftest import GRANULARITIES
from tests.plan.gbnf import Gbnf


def test_the_pinned_grammar_allows_the_counted_tokens_and_nothing_else(format_: Format, tokenize: Tokenize) -> None:
    allowed = Gbnf(grammar(format_, 1, tokenize)).words("root")
    assert sorted(allowed) == sorted(tuple(tokenize(text_of(format_, [call]))) for call in format_.skills.calls)


def test_what_the_pinned_grammar_allows_is_the_tokens_of_a_plan(format_: Format, tokenize: Tokenize) -> None:
    rng = random.Random(2)
    words = {tuple(tokenize(format_.line(number, text))) for number in range(1, 9) for text in format_.texts}
    read = Gbnf(grammar(format_, 8, tokenize))
    for _ in range(20):
        tokens = tuple(read.sample(rng))
        for _skill in range(8):
            length = next(size for size in range(1, len(tokens) + 1) if tokens[:size] in words)
            tokens = tokens[length:]
        assert tokens == ()


@pytest.mark.parametrize("n_skills", [1, 8, 32])
@pytest.mark.parametrize("pinned", [False, True])
def test_llama_cpp_takes_it(format_: Format, tokenize: Tokenizer, n_skills: int, pinned: bool) -> None:
    text = grammar(format_, n_skills, tokenize if pinned else None)
    assert grammar_error(tokenize._vocab, text) == ""


def test_a_number_may_share_a_token_with_what_follows() -> None:
    def pairs(text: str) -> list[int]:
        return [int.from_bytes(text[at : at + 2].encode(), "big") for at in range(0, len(text), 2)]

    paper = paper_format(load_skills("driving"))
    read = Gbnf(grammar(paper, 11, pairs))
    assert set(read.rules) == {"root", "skill", "skill1"}  # after a number of one digit, and of two
    tokens = map(int, map(str, read.sample(random.Random(4))))
    answer = "".join(token.to_bytes(2, "big").decode().lstrip("\0") for token in tokens)
    assert [type(event) for event in Parser(paper).feed(answer)] == [SkillParsed] * 11
    assert [line.partition(".")[0] for line in answer.splitlines()] == [str(number) for number in range(1, 12)]


def test_characters_that_mean_something_in_gbnf_are_escaped(of_bytes: Tokenizer) -> None:
    marks = ['a"b', "a\\b", "a]b", "a^b", "a-b", "a[b", "üb", "a{2}", "a|b", "a", "]", "^", "-", "\\", '"', "ß", "{"]
    text = f"""
name = "marks"
role = "planner"
gap = "hold"
vocabulary.mark = [{", ".join("'" + mark + "'" for mark in marks)}]
[[skill]]
name = "say"
arguments = ["mark"]
t_nom_s = 1
"""
    skills = parse_skills(text, "marks.toml")
    text = grammar(paper_format(skills), 1)
    spoken = ["".join(map(str, word)) for word in Gbnf(text).words("root")]
    assert sorted(spoken) == sorted(f"1. say({mark})\n" for mark in marks)
    assert grammar_error(of_bytes._vocab, text) == ""


def test_a_plan_has_a_skill(format_: Format) -> None:
    with pytest.raises(UsageError, match="at least one skill, not 0"):
        grammar(format_, 0)


@pytest.fixture(scope="module")
def engine(tiny: EngineConfig) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(tiny)
    yield engine
    engine.close()


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
        request = Request("r", prompt(format_, 8, "Go."), max_tokens=300, grammar=gbnf, seed=seed)
        for count, token in enumerate(engine.generate(request)):
            found = parser.feed(token.text)
            assert bool(found) == ((count + 1) % size == 0)
            events += found
        assert parser.close() == []
        assert all(isinstance(event, SkillParsed) for event in events)
        assert [event.piece for event in events] == [size * at - 1 for at in range(1, 9)]
