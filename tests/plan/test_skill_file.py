from pathlib import Path

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plan import SKILL_SETS, load_skills, parse_skills
from s2a_bench.types import Timing

ARM = """
name = "arm"
role = "planner"
gap = "hold"
[vocabulary]
thing = ["cup", "küche"]
height = { from = 0.1, to = 0.3, step = 0.1 }
[[skill]]
name = "lift"
arguments = ["thing", "by:height", "onto:thing"]
t_nom_s = 2
[[skill]]
name = "home"
t_min_s = 1
t_nom_s = 1.5
t_max_s = 1.5
gap = "stop"
"""


def test_a_skill_has_what_the_file_says() -> None:
    skills = parse_skills(ARM, "arm.toml")
    lift, home = skills.skills
    assert (skills.name, skills.role, skills.gap) == ("arm", "planner", "hold")
    assert lift.signature == "lift(thing, by: height, onto: thing)"
    assert lift.arguments[1].values == (0.1, 0.2, 0.3)
    assert lift.durations == Timing(2.0, 1.6, 3.0)  # the defaults are .8 and 1.5 times the nominal
    assert home.durations == Timing(1.5, 1.0, 1.5)
    assert (lift.gap, home.gap) == ("hold", "stop")


def test_the_calls_are_all_there_are() -> None:
    calls = parse_skills(ARM, "arm.toml").calls
    assert len(set(calls)) == 2 * 3 * 2 + 1
    assert str(calls[0]) == "lift(cup, 0.1, cup)"
    assert calls[5].arguments == {"thing": "cup", "by": 0.3, "onto": "küche"}
    assert str(calls[-1]) == "home()"


def test_what_is_just_allowed_is_read() -> None:
    word = 64 * "k"
    text = ARM.replace("küche", word).replace('"home"', f'"{word}"').replace("t_nom_s = 2", "t_nom_s = 1e9")
    lift, home = parse_skills(text, "arm.toml").skills
    assert lift.arguments[0].values == ("cup", word)
    assert (lift.durations.nominal_s, home.name) == (1e9, word)
    numbers = ARM.replace("{ from = 0.1, to = 0.3, step = 0.1 }", "[-1, 2.5, 3.0]")
    assert parse_skills(numbers, "arm.toml").vocabularies["height"] == (-1, 2.5, 3)
    single = ARM.replace('["cup", "küche"]', '["cup"]').replace("to = 0.3", "to = 0.1")
    assert len(parse_skills(single, "arm.toml").calls) == 2
    many = single.replace("to = 0.1", "to = 102.3")
    assert len(parse_skills(many, "arm.toml").calls) == 1024
    steady = ARM.replace("t_min_s = 1\n", "t_min_s = 1.5\n")
    assert parse_skills(steady, "arm.toml").skills[1].durations == Timing(1.5, 1.5, 1.5)


def test_whole_numbers_stay_whole() -> None:
    skills = load_skills("driving")
    assert skills.vocabularies["speed"] == tuple(range(0, 65, 5))
    assert all(type(value) is int for value in skills.vocabularies["speed"])


@pytest.mark.parametrize("name", SKILL_SETS)
def test_a_shipped_set_is_a_file_to_copy(name: str, tmp_path: Path) -> None:
    file = Path(__file__).parents[2] / "s2a_bench/plan/skills" / f"{name}.toml"
    copy = tmp_path / "mine.toml"
    copy.write_text(file.read_text("utf-8"), "utf-8")
    assert load_skills(str(copy)) == load_skills(name)


def test_the_household_speaks_the_papers_plan() -> None:
    calls = {str(call) for call in load_skills("household").calls}
    assert {"go_to(kitchen)", "pick(cup)", "go_to(table)", "place(cup, table)"} <= calls


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('gap = "hold"', 'gap = "fly"', "gap: 'fly' should be 'stop', 'coast', 'hold' or 'cruise'"),
        ('gap = "stop"', "gap = 3", "skill[home].gap: 3 should be 'stop', 'coast', 'hold' or 'cruise'"),
        ('role = "planner"', "", "role: is missing"),
        ('role = "planner"', 'role = "a\\nb"', "role: should be a text of one line"),
        ('role = "planner"', 'role = "p"\nrule = 1', "rule: there is no such key; did you mean role?"),
        ("t_nom_s = 2", "", "skill[lift].t_nom_s: is missing"),
        ("t_nom_s = 2", "t_nom_s = inf", "skill[lift].t_nom_s: should be a number"),
        ("t_nom_s = 2", "t_nom_s = 1000000001", "skill[lift].t_nom_s: should be a number"),
        ("t_nom_s = 2", "t_nom_s = 0", "skill[lift]: 0 < t_min_s <= t_nom_s <= t_max_s does not hold"),
        ("t_nom_s = 2", "t_nom_s = 2\nt_max_s = 1.9", "skill[lift]: 0 < t_min_s <= t_nom_s <= t_max_s"),
        ("t_nom_s = 2", "t_nom = 2", "skill[lift].t_nom: there is no such key; did you mean t_nom_s?"),
        ('name = "home"', 'name = "go home"', "skill[1].name: 'go home' should be letters, digits and underscores"),
        ('name = "home"', 'name = "lift"', "skill: 'lift' stands there twice"),
        ('name = "home"', "", "skill[1].name: is missing"),
        ('"thing", "by', '"stuff", "by', "skill[lift].arguments: the vocabulary 'stuff' is not defined (thing, "),
        ('"onto:thing"', '"thing"', "skill[lift].arguments: 'thing' stands there twice"),
        ('"onto:thing"', "3", "skill[lift].arguments[2]: 3 should be a text"),
        ('"küche"', '"a b"', "vocabulary.thing: 'a b' should be printable, without blanks, brackets and commas"),
        ('"küche"', '"a\ufffd"', "vocabulary.thing: 'a\ufffd' should be printable"),
        ('"küche"', '""', "vocabulary.thing: '' should have 1 to 64 characters"),
        ('"küche"', f'"{65 * "k"}"', f"vocabulary.thing: '{65 * 'k'}' should have 1 to 64 characters"),
        ('name = "home"', f'name = "{65 * "k"}"', f"skill[{65 * 'k'}].name: '{65 * 'k'}' should be letters"),
        ('"küche"', '"cup"', "vocabulary.thing: 'cup' stands there twice"),
        ('"küche"', "3", "vocabulary.thing: should be a list of texts, a list of numbers"),
        ('["cup", "küche"]', "[]", "vocabulary.thing: should be a list of texts"),
        ("[vocabulary]", '[vocabulary]\nodd = ["a"]', "vocabulary.odd: no skill has an argument of it"),
        ("to = 0.3", "to = 0.35", "vocabulary.height: 0.35 is not reached from 0.1 in steps of 0.1"),
        ("step = 0.1", "step = 0", "vocabulary.height: a range needs from <= to and step > 0"),
        ("step = 0.1", 'step = "x"', "vocabulary.height: a range has the numbers from, to, step, and nothing else"),
        ("step = 0.1", "step = 0.1, unit = 1", "vocabulary.height: a range has the numbers from, to, step, and no"),
        ("to = 0.3", "to = 102.5", "vocabulary.height: 1025 values; at most 1024 calls are allowed, use a coarser"),
        ("to = 0.3", "to = 100000", "vocabulary.height: 1000000 values; at most 1024"),
        ("to = 0.3", "to = 30", "skill: 1201 calls are possible, at most 1024"),
        ("[[skill]]", "[[skills]]", "skills: there is no such key; did you mean skill?"),
        ("to = 0.3", "to = 25.6", "skill: 1025 calls are possible, at most 1024"),
    ],
)
def test_an_error_names_file_and_key(old: str, new: str, message: str) -> None:
    assert old in ARM
    with pytest.raises(UsageError) as caught:
        parse_skills(ARM.replace(old, new), "arm.toml")
    assert str(caught.value).startswith(f"`skills` arm.toml: {message}")
    assert caught.value.exit_code == 2


def test_a_choice_that_is_neither_a_name_nor_a_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`skills`: 'kitchen' is not one of household, driving, and no path"):
        load_skills("kitchen")
    with pytest.raises(UsageError, match=r"`skills`: cannot read /no/such\.toml: .*No such file"):
        load_skills("/no/such.toml")
    latin = tmp_path / "latin.toml"
    latin.write_bytes("name = 'küche'".encode("latin-1"))
    with pytest.raises(UsageError, match=r"`skills`: cannot read .*latin\.toml: .* in position 9: invalid start byte"):
        load_skills(str(latin))
