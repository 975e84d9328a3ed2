"""Skill sets and tokenizers that nobody thought of."""

import random
import re
from collections.abc import Callable

from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.plan_text import text_of
from s2a_bench.errors import UsageError
from s2a_bench.plan import (
    Argument,
    Parser,
    Skill,
    SkillParsed,
    SkillSet,
    Tokenize,
    choose_format,
    grammar,
    paper_format,
)
from s2a_bench.types import Timing
from studies.validity import Cost, cost_of
from tests.conftest import examples
from tests.plan.gbnf import Gbnf

NAME = st.text("abcgop_ü鍋0", min_size=1, max_size=6).filter(str.isidentifier)
WORD = st.text("abck19.-~_=\"'\\[]^{}|<>!鍋🥄ü", min_size=1, max_size=4)
NUMBER = st.integers(-20, 20) | st.integers(-20, 20).map(lambda value: value / 2 + 0.25)


@st.composite
def skill_sets(draw: st.DrawFn) -> SkillSet:
    vocabularies = {
        name: tuple(draw(st.lists(kind, min_size=1, max_size=4, unique_by=str)))
        for name, kind in zip("xyz", (WORD, NUMBER, WORD), strict=True)
    }
    signatures = draw(
        st.dictionaries(NAME, st.lists(st.sampled_from("xyz"), max_size=3), min_size=1, max_size=4),
    )
    skills = []
    for name, keys in signatures.items():
        arguments = tuple(Argument(f"a{at}", key, vocabularies[key]) for at, key in enumerate(keys))
        skills.append(Skill(name, arguments, Timing(2, 1, 3), "hold"))
    return SkillSet("any", "planner", "hold", tuple(skills))


def by(pattern: str) -> Tokenize:
    """Return a tokenizer that gives each text its own number."""
    known: dict[str, int] = {}
    return lambda text: [known.setdefault(piece, len(known)) for piece in re.findall(pattern, text, re.DOTALL)]


TOKENIZERS: dict[str, Callable[[], Tokenize]] = {
    "bytes": lambda: lambda text: list(text.encode()),
    "characters": lambda: by("."),
    "words": lambda: by(r" ?\w+|\s|[^\w\s]+\n*"),
    "pairs": lambda: by("..?"),
    "blanks with words": lambda: by(r"\s?\S+|\s"),
}


@settings(max_examples=examples(150))
@given(skill_sets(), st.sampled_from(list(TOKENIZERS)), st.integers(1, 8), st.sampled_from([1, 8, 12]), st.randoms())
def test_a_format_is_exact_and_can_be_read_or_is_refused(
    skills: SkillSet, tokenizer: str, tokens: int, n_skills: int, rng: random.Random
) -> None:
    tokenize = TOKENIZERS[tokenizer]()
    formats = [paper_format(skills)]
    try:
        chosen = choose_format(skills, tokens, tokenize, n_skills)
    except UsageError as error:
        assert str(error).startswith(f"`tokens_per_skill` {tokens}: ")  # noqa: PT017 both are right
    else:
        assert cost_of(chosen, tokenize, n_skills) == Cost(tokens, float(tokens), tokens)
        formats.append(chosen)
    for format_ in formats:
        for call in skills.calls:
            assert Parser(format_).feed(text_of(format_, [call])) == [SkillParsed(0, call, 0, 0)]
        allowed = Gbnf(grammar(format_, 1)).words("root")
        assert sorted("".join(map(str, word)) for word in allowed) == sorted(
            text_of(format_, [call]) for call in skills.calls
        )
        plan = text_of(format_, rng.choices(skills.calls, k=n_skills))
        for answer in (plan, "".join(map(str, Gbnf(grammar(format_, n_skills)).sample(rng)))):
            parser = Parser(format_)
            events = [event for char in answer for event in parser.feed(char)]
            assert parser.close() == []
            calls = [event.call for event in events if isinstance(event, SkillParsed)]
            assert len(calls) == len(events) == n_skills
            assert text_of(format_, calls) == answer
        pinned = Gbnf(grammar(format_, n_skills, tokenize)).sample(rng)
        if format_ is not formats[0]:
            assert len(pinned) == tokens * n_skills
