import random
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.plan import (
    BadLine,
    Event,
    Format,
    Parser,
    SkillParsed,
    Tokenize,
    choose_format,
    load_skills,
    paper_format,
    parse_skills,
)
from tests.conftest import examples

many = settings(max_examples=examples(200))

UMLAUTS = """
name = "küche"
role = "Küchenhilfe"
gap = "hold"
vocabulary.ding = ["Löffel", "鍋", "🥄", "🥄🥄", "Löff"]
[[skill]]
name = "öffne"
arguments = ["ding"]
t_nom_s = 1
[[skill]]
name = "warte"
t_nom_s = 1
"""


def bytewise(text: str) -> list[int]:
    return list(text.encode())


HOUSEHOLD, DRIVING, KITCHEN = load_skills("household"), load_skills("driving"), parse_skills(UMLAUTS, "umlauts")
FORMATS = {
    **{f"paper {skills.name}": paper_format(skills) for skills in (HOUSEHOLD, DRIVING, KITCHEN)},
    **{
        f"{size} {skills.name}": choose_format(skills, size, bytewise)
        for skills in (HOUSEHOLD, DRIVING)
        for size in (6, 4, 2, 1)
    },
    "words": choose_format(DRIVING, 4, lambda text: re.findall(r"\S+|\n", text)),  # type: ignore[arg-type, return-value]
    "küche": choose_format(KITCHEN, 6, lambda text: re.findall(r"\w+|\S|\n", text)),  # type: ignore[arg-type, return-value]
    "pairs": choose_format(DRIVING, 1, lambda text: re.findall(r" ?[A-Za-z]{2}|.", text)),  # type: ignore[arg-type, return-value]
}
formats = st.sampled_from(list(FORMATS.values()))


def parse(format_: Format, chunks: list[bytes] | list[str]) -> list[Event]:
    parser = Parser(format_)
    return [event for chunk in chunks for event in parser.feed(chunk)] + parser.close()


def without_chunks(events: list[Event]) -> list[tuple[object, ...]]:
    return [
        (event.index, event.call, event.line)
        if isinstance(event, SkillParsed)
        else (event.problem, event.text, event.why, event.line)
        for event in events
    ]


def calls(events: list[Event]) -> list[str]:
    return [str(event.call) for event in events if isinstance(event, SkillParsed)]


def problems(events: list[Event]) -> list[str]:
    return [event.problem for event in events if isinstance(event, BadLine)]


@st.composite
def answers(draw: st.DrawFn) -> tuple[Format, bytes]:
    """Lines of one format, whole, cut, doubled, changed, and anything else between them."""
    format_ = draw(formats)
    line = st.sampled_from(format_.lines(1)).map(str.encode)
    cut = st.tuples(line, st.integers(0, 40)).map(lambda pair: pair[0][: pair[1]])
    blank = st.sampled_from([b" ", b"\n", b"\t", b"\r\n", b"  \n", "\u00a0".encode()])
    noise = st.one_of(
        st.binary(max_size=12), st.text(max_size=8).map(str.encode), st.binary(min_size=180, max_size=220)
    )
    return format_, b"".join(draw(st.lists(st.one_of(line, line, cut, blank, noise), max_size=12)))


@st.composite
def cuts(draw: st.DrawFn, data: bytes) -> list[bytes]:
    at = sorted(draw(st.lists(st.integers(0, len(data)), max_size=20)))
    return [data[start:end] for start, end in zip([0, *at], [*at, len(data)], strict=True)]


@many
@given(answers(), st.data())
def test_any_chunking_gives_the_same_skills(answer: tuple[Format, bytes], data: st.DataObject) -> None:
    format_, text = answer
    whole = without_chunks(parse(format_, [text]))
    assert without_chunks(parse(format_, data.draw(cuts(text)))) == whole
    assert without_chunks(parse(format_, [bytes([byte]) for byte in text])) == whole
    assert without_chunks(parse(format_, list(text.decode(errors="replace")))) == whole


def obvious(format_: Format, text: str) -> Iterator[str]:
    """Yield the calls of whole lines, found with a regular expression for each call."""
    patterns = {}
    for call, written in zip(format_.skills.calls, format_.texts, strict=True):
        pieces = re.findall(r"[(),]|[^\s(),]+", written)
        pattern = re.escape(pieces[0])
        for before, after in pairwise(pieces):
            pattern += (r"\s*" if {before, after} & set("(),") else r"\s+") + re.escape(after)
        number = r"[0-9]+\.\s*" if format_.numbered else ""
        patterns[str(call)] = re.compile(rf"\s*{number}{pattern}\s*")
    for line in text.split("\n")[:-1]:
        yield from (call for call, pattern in patterns.items() if pattern.fullmatch(line))


@many
@given(answers().filter(lambda answer: answer[0].delimiter == "\n"))
def test_it_finds_what_an_obvious_reader_finds(answer: tuple[Format, bytes]) -> None:
    format_, data = answer
    text = data.decode(errors="replace")
    limit = Parser(format_)._reader._limit  # type: ignore[union-attr]
    short = "".join(f"{line}\n" for line in text.split("\n")[:-1] if len(line) <= limit)
    parser = Parser(format_)
    assert calls(parser.feed(data)) == list(obvious(format_, short))


@many
@given(formats, st.binary(max_size=2000), st.integers(1, 50))
def test_no_bytes_break_it_and_what_it_keeps_is_bounded(format_: Format, data: bytes, size: int) -> None:
    parser = Parser(format_)
    events = []
    for start in range(0, len(data), size):
        events += parser.feed(data[start : start + size])
        kept = [value for value in vars(parser._reader).values() if isinstance(value, str)]
        assert sum(map(len, kept)) <= 64 + 2 * max(map(len, format_.texts))
    events += parser.close()
    assert len(events) <= len(data)
    assert [event.line for event in events] == list(range(len(events)))


@given(formats, st.text(st.characters(exclude_categories=()), max_size=200))
def test_no_text_breaks_it_surrogates_included(format_: Format, text: str) -> None:
    assert not {"\ufffd"} & set("".join(calls(parse(format_, [text]))))


def test_a_lone_surrogate_is_not_the_code_that_python_replaces_it_with() -> None:
    stream = replace(FORMATS["1 household"], texts=("?", *FORMATS["1 household"].texts[1:]))
    assert calls(parse(stream, ["?"])) == ["go_to(kitchen)"]
    assert calls(parse(stream, ["\ud800"])) == []


@pytest.mark.parametrize("name", ["paper household", "4 household", "1 household", "pairs", "küche"])
@pytest.mark.parametrize("piece", [b"x", b" ", b"\xff", b"1", b"(", b"\n", b"go_to(kitchen)\n"])
def test_work_grows_with_the_length_only(name: str, piece: bytes) -> None:
    def work(data: bytes, size: int) -> int:
        count = 0

        def step(_frame: object, event: str, _arg: object) -> None:
            nonlocal count
            count += event in {"call", "c_call"}

        parser = Parser(FORMATS[name])
        chunks = [data[start : start + size] for start in range(0, len(data), size)]
        sys.setprofile(step)
        try:
            for chunk in chunks:
                parser.feed(chunk)
        finally:
            sys.setprofile(None)
        return count

    for size in (3, 10**9):
        once, fourfold = work(piece * 1000, size), work(piece * 4000, size)
        assert fourfold <= 4 * once + 100


def test_a_skill_comes_with_the_token_that_completes_it(format_: Format, tokenize: Tokenize) -> None:
    rng = random.Random(3)
    plan = rng.choices(format_.skills.calls, k=8)
    lines = [
        tokenize(format_.line(number, format_.texts[format_.skills.calls.index(call)]))
        for number, call in enumerate(plan, 1)
    ]
    parser = Parser(format_)
    found = []
    for ids in lines:
        for token in ids:
            found += parser.feed(tokenize.piece(token))  # type: ignore[attr-defined]
    assert [event.call for event in found] == plan
    assert [event.piece for event in found] == [sum(map(len, lines[: at + 1])) - 1 for at in range(8)]
    assert [event.index for event in found] == list(range(8))


PAPER = FORMATS["paper household"]


def test_a_skill_is_certain_at_its_delimiter_and_not_before() -> None:
    parser = Parser(PAPER)
    assert parser.feed("1. go_to(kitchen)") == []
    (event,) = parser.feed("\n2. pick")
    assert isinstance(event, SkillParsed)
    assert (event.index, str(event.call), event.line, event.piece) == (0, "go_to(kitchen)", 0, 1)
    assert event.call.skill.durations.nominal_s == 4.0
    assert parser.feed("(cup)") == []
    (last,) = parser.close()
    assert isinstance(last, SkillParsed)
    assert (last.index, str(last.call), last.line, last.piece) == (1, "pick(cup)", 1, 3)


def test_a_code_is_certain_at_once() -> None:
    parser = Parser(FORMATS["1 household"])
    (event,) = parser.feed("B")
    assert isinstance(event, SkillParsed)
    assert str(event.call) == "go_to(table)"
    pairs = Parser(FORMATS["pairs"])
    first = FORMATS["pairs"].texts[1].strip()
    assert pairs.feed(" ") + pairs.feed(first[0]) == []
    assert calls(pairs.feed(first[1])) == ["set_speed(5)"]


@pytest.mark.parametrize(
    ("line", "problem", "why"),
    [
        ("1. dance(kitchen)", "unknown-skill", "'dance' is not one of the skills"),
        ("1. Go_to(kitchen)", "unknown-skill", "'Go_to' is not one of the skills"),
        ("1. go_to(moon)", "bad-argument", "'moon' is not a valid location of go_to"),
        ("1. place(cup)", "bad-argument", "place has 2 arguments, 1 are given"),
        ("1. place(table, cup)", "bad-argument", "'table' is not a valid object of place"),
        ("1. go_to()", "bad-argument", "go_to has 1 arguments, 0 are given"),
        ("1. go_to(kitchen, kitchen)", "malformed", "go_to is not written as listed"),
        ("1. go_to(kitchen) and rest", "malformed", "go_to is not written as listed"),
        ("1. go_to kitchen", "malformed", "should look like 'go_to(kitchen)'"),
        ("go_to(kitchen)", "malformed", "a number and a dot should come first"),
        ("\u0661. go_to(kitchen)", "malformed", "a number and a dot should come first"),
        ("1.", "malformed", "should look like 'go_to(kitchen)'"),
        ("1. go_to(kitchen)" + " " * 200, "too-long", "more than 108 characters without the end of a line"),
    ],
)
def test_a_bad_line_is_named_and_the_next_one_is_read(line: str, problem: str, why: str) -> None:
    bad, good = parse(PAPER, [f"{line}\n2. pick(cup)\n"])
    assert isinstance(bad, BadLine)
    assert (bad.problem, bad.why, bad.line, bad.piece) == (problem, why, 0, 0)
    assert line.startswith(bad.text)
    assert isinstance(good, SkillParsed)
    assert (good.index, str(good.call), good.line) == (0, "pick(cup)", 1)


@pytest.mark.parametrize(
    "line", ["1.go_to( kitchen )", "  1.   go_to (kitchen)\r", "07.\tgo_to(kitchen)  ", "99. go_to(kitchen)"]
)
def test_blanks_and_the_value_of_a_number_mean_nothing(line: str) -> None:
    assert calls(parse(PAPER, [f"\n \n{line}\n\n"])) == ["go_to(kitchen)"]


@pytest.mark.parametrize(
    ("format_", "answer", "found", "wrong"),
    [
        (FORMATS["paper driving"], "1. set_speed(5)", ["set_speed(5)"], []),
        (FORMATS["paper driving"], "1. set_speed(5", [], ["incomplete"]),
        (FORMATS["paper driving"], "1. set_speed(7", [], ["malformed"]),
        (FORMATS["paper driving"], "1", [], ["incomplete"]),
        (FORMATS["paper driving"], " \n ", [], []),
        (FORMATS["words"], "1. set_speed 5", [], ["incomplete"]),
        (FORMATS["4 household"], "gk-", ["go_to(kitchen)"], []),
        (FORMATS["4 household"], "gk", [], ["incomplete"]),
        (FORMATS["pairs"], f"{FORMATS['pairs'].texts[0]} a", ["set_speed(0)"], ["incomplete"]),
        (FORMATS["paper küche"], "1. warte()\n2. öffne(🥄", ["warte()"], ["incomplete"]),
        (
            FORMATS["paper küche"],
            "1. öffne(🥄)\n2. öffne(🥄🥄)\n3. öffne(Löff)",
            ["öffne(🥄)", "öffne(🥄🥄)", "öffne(Löff)"],
            [],
        ),
    ],
)
def test_what_the_end_leaves_open_is_not_guessed(
    format_: Format, answer: str, found: list[str], wrong: list[str]
) -> None:
    events = parse(format_, [answer])
    assert (calls(events), problems(events)) == (found, wrong)


def test_a_bad_run_of_codes_ends_at_a_blank() -> None:
    events = parse(FORMATS["1 household"], ["AB?CD E\n.F\nG"])
    assert calls(events) == ["go_to(kitchen)", "go_to(table)", "open(cup)", "open(bottle)"]
    assert [(event.text, event.problem, event.line) for event in events if isinstance(event, BadLine)] == [
        ("?", "unknown-skill", 2),
        (".", "unknown-skill", 4),
    ]


def test_codes_that_are_listed_apart_must_come_apart() -> None:
    apart = choose_format(HOUSEHOLD, 1, lambda text: re.findall(r" ?[A-Za-z]+|.", text))  # type: ignore[arg-type, return-value]
    events = parse(apart, ["The plan: A BC\nD"])
    assert [str(event.call) if isinstance(event, SkillParsed) else event.text for event in events] == [
        *("place(cup, sofa)", "h"),  # T is certain as soon as it is there
        "p",
        *("go_to(kitchen)", "go_to(table)", "C", "go_to(sofa)"),
    ]


def test_one_line_that_never_ends_is_one_error_and_takes_no_memory() -> None:
    parser = Parser(PAPER)
    events = [event for _ in range(1000) for event in parser.feed("go on " * 100)]
    assert problems(events) == ["too-long"]
    assert events[0].piece == 0
    assert calls(parser.feed("\n1. pick(cup)\n")) == ["pick(cup)"]


def test_it_can_be_closed_once_and_not_fed_then() -> None:
    parser = Parser(PAPER)
    parser.feed("1. pick(cup)")
    assert len(parser.close()) == 1
    assert parser.close() == []
    with pytest.raises(ValueError, match="the parser is closed"):
        parser.feed("\n")
