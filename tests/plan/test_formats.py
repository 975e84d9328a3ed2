import random
import re
from dataclasses import replace

import pytest

from benchmarks.plan_text import text_of
from s2a_bench.errors import UsageError
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.plan import (
    Format,
    SkillSet,
    Tokenize,
    choose_format,
    load_skills,
    paper_format,
    parse_skills,
    prompt,
)
from studies.validity import Cost, cost_of
from tests.plan.conftest import GRANULARITIES


def many(count: int) -> SkillSet:
    text = f"""
name = "many"
role = "planner"
gap = "hold"
vocabulary.number = {{ from = 1, to = {count}, step = 1 }}
[[skill]]
name = "say"
arguments = ["number"]
t_nom_s = 1
"""
    return parse_skills(text, "many.toml")


@pytest.mark.parametrize("tokens", GRANULARITIES)
@pytest.mark.parametrize("n_skills", [4, 32])
def test_every_call_and_every_plan_costs_exactly_what_was_asked_for(
    skills: SkillSet, tokenize: Tokenize, tokens: int, n_skills: int
) -> None:
    chosen = choose_format(skills, tokens, tokenize, n_skills)
    assert cost_of(chosen, tokenize, n_skills) == Cost(tokens, float(tokens), tokens)
    for call in skills.calls:
        assert len(tokenize(text_of(chosen, [call]))) == tokens
    rng = random.Random(tokens)
    for _ in range(20):
        plan = rng.choices(skills.calls, k=n_skills)
        assert len(tokenize(text_of(chosen, plan))) == tokens * n_skills


@pytest.mark.parametrize("tokens", GRANULARITIES)
def test_words_are_preferred_where_they_fit(of_bytes: Tokenizer, tokens: int) -> None:
    terse = ["numbered letters, filled up", "letters, filled up", "codes", "code stream"]
    assert choose_format(load_skills("household"), tokens, of_bytes).name == terse[GRANULARITIES.index(tokens)]

    def of_words(text: str) -> list[int]:
        words = text.replace("(", " ( ").replace(")", " ) ").replace("\n", " ; ").split()
        return [hash(word) for word in words]

    plain = ["calls, filled up", "words, filled up", "numbered letters", "code stream"]
    assert choose_format(load_skills("household"), tokens, of_words).name == plain[GRANULARITIES.index(tokens)]


def test_a_number_of_two_digits_counts(of_bytes: Tokenizer) -> None:
    skills = load_skills("household")
    one_digit = choose_format(skills, 6, of_bytes, n_skills=9)
    two_digits = choose_format(skills, 6, of_bytes, n_skills=10)
    assert (one_digit.numbered, two_digits.numbered) == (True, False)
    assert cost_of(one_digit, of_bytes, 9) == Cost(6, 6.0, 6)
    assert cost_of(one_digit, of_bytes, 10) == Cost(6, 6.1, 7)


def test_the_papers_format_costs_what_it_costs(of_bytes: Tokenizer) -> None:
    paper = paper_format(load_skills("household"))
    costs = [len(f"1. {call}\n".replace(" t", "t")) for call in paper.skills.calls]  # " t" is the only merge
    assert cost_of(paper, of_bytes, 8) == Cost(min(costs), sum(costs) / 32, max(costs))


def test_codes_of_one_token_need_nothing_between_them(tokenize: Tokenize, skills: SkillSet) -> None:
    stream = choose_format(skills, 1, tokenize)
    assert stream.delimiter == ""
    keys = list(stream.table)
    assert len({tokenize(text)[0] for text in stream.texts}) == len(skills.calls)
    assert not any(one != other and other.startswith(one) for one in keys for other in keys)
    for first in stream.texts:
        for second in stream.texts:
            assert tokenize(first + second) == tokenize(first) + tokenize(second)


def test_codes_that_would_merge_with_another_are_not_taken_nor_are_two_of_one_token() -> None:
    def a_and_b_merge(text: str) -> list[int]:
        return [hash(piece) for piece in re.findall("AB|.", text)]

    def capitals_are_small(text: str) -> list[int]:
        return [ord(char.lower()) for char in text]

    assert choose_format(many(3), 1, a_and_b_merge).texts == ("A", "C", "D")
    assert choose_format(many(27), 1, capitals_are_small).texts[25:] == ("Z", "0")


def test_there_are_letters_for_62_words_and_codes_for_94_calls(of_bytes: Tokenizer) -> None:
    assert choose_format(many(62), 3, of_bytes).name == "letters"
    assert choose_format(many(63), 3, of_bytes).name == "codes, filled up"
    assert choose_format(many(94), 2, of_bytes).name == "codes"


def test_lines_that_cost_something_else_in_a_row_are_not_taken() -> None:
    def line_ends_merge(text: str) -> list[int]:
        return [hash(piece) for piece in re.findall(r"\n[a-zA-Z]|.|\n", text)]

    chosen = choose_format(many(3), 5, line_ends_merge)
    assert chosen.name == "numbered letters"
    assert len(line_ends_merge(text_of(chosen, chosen.skills.calls))) == 15
    with pytest.raises(UsageError, match="`tokens_per_skill` 2: no way found"):
        choose_format(many(3), 2, line_ends_merge)


def test_what_the_vocabulary_cannot_say_is_refused_with_the_limit(of_bytes: Tokenizer, of_words: Tokenizer) -> None:
    assert cost_of(choose_format(many(94), 1, of_bytes), of_bytes, 8) == Cost(1, 1.0, 1)
    with pytest.raises(UsageError, match="`tokens_per_skill` 1: 'many' has 95 calls, but only 94 codes of one token"):
        choose_format(many(95), 1, of_bytes)
    with pytest.raises(UsageError, match=r"`tokens_per_skill` 2: no way .* 95 calls of 'many'.* cost up to 7"):
        choose_format(many(95), 2, of_bytes)
    with pytest.raises(UsageError, match="`tokens_per_skill`: 0 should be 1 or more"):
        choose_format(many(2), 0, of_bytes)
    with pytest.raises(UsageError, match="a plan has at least one skill, not 0"):
        choose_format(many(2), 2, of_bytes, n_skills=0)
    assert cost_of(choose_format(many(300), 2, of_words), of_words, 8) == Cost(2, 2.0, 2)  # codes of two letters


def test_two_calls_that_read_alike_are_no_format() -> None:
    paper = paper_format(load_skills("household"))
    with pytest.raises(ValueError, match="numbered calls: two calls have the same text"):
        replace(paper, texts=(paper.texts[1], *paper.texts[1:]))


def test_the_prompt_is_the_papers() -> None:
    assert prompt(paper_format(load_skills("household")), 8, "Bring the cup to the table.").splitlines() == [
        "You are a robot task planner.",
        "Skills: go_to(location), open(object), close(object), pick(object), place(object, location).",
        "location: kitchen, table, shelf, sofa.",
        "object: cup, box, bottle, jar.",
        "Rules: Output only numbered skill calls, one per line.",
        "Output exactly 8 of them.",
        "Do not output any explanation.",
        "Task: Bring the cup to the table.",
    ]


def test_the_prompt_lists_every_code(of_bytes: Tokenizer) -> None:
    skills = load_skills("driving")
    stream = choose_format(skills, 1, of_bytes)
    text = prompt(stream, 5)
    listed = text.partition("Codes:\n")[2].partition("Rules:")[0].splitlines()
    assert listed == [f"{code} = {call}" for code, call in zip("ABCDEFGHIJKLMNO", skills.calls, strict=True)]
    assert "Output only codes in one line, such as AB.\n" in text
    assert "Task" not in text
    numbered = choose_format(skills, 6, of_bytes)
    assert "Output only numbered codes such as 1.sa-, one per line.\n" in prompt(numbered, 5)


def test_every_prompt_names_every_call(format_: Format) -> None:
    text = prompt(format_, 8)
    if "Codes:" in text:
        pairs = zip(format_.texts, format_.skills.calls, strict=True)
        assert all(f"{code.strip()} = {call}\n" in text for code, call in pairs)
    else:
        assert format_.texts == tuple(map(str, format_.skills.calls))
