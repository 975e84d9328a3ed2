import re
from pathlib import Path

import pytest

from s2a_bench.plan import parse_skills
from s2a_bench.types import Timing

PAGE = (Path(__file__).parents[2] / "docs/plans.md").read_text("utf-8")


def example(language: str) -> str:
    (found,) = re.findall(rf"```{language}[^\n]*\n(.*?)```", PAGE, re.DOTALL)
    return str(found)


def test_the_skill_set_of_the_page_is_one() -> None:
    lift = parse_skills(example("toml"), "docs/plans.md").skills[0]
    assert lift.signature == "lift(object, by: height)"
    assert (lift.durations, lift.gap) == (Timing(2.0, 1.6, 3.0), "stop")


def test_the_parser_of_the_page_says_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(example("python"), "docs/plans.md", "exec"), {})  # noqa: S102 our own page
    assert capsys.readouterr().out == "0 open(cup) 0\n{'object': 'cup'} 2.0 hold\n"
