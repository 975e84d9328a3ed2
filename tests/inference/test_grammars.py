"""Grammars that would end llama.cpp's process are refused before it sees them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from s2a_bench.inference.llama_decode import DEPTH, REPETITIONS, RULES, beyond_limits
from s2a_bench.plan import grammar, load_skills, paper_format

HOSTILE = {
    "parentheses": ("root ::= " + "(" * 20_000 + '"a"' + ")" * 20_000, "nests deeper"),
    "open parentheses": ("root ::= " + "(" * 20_000, "nests deeper"),
    "NUL": ('root ::= "a\0b"', "NUL"),
    "long": ('root ::= "' + "a" * (1 << 20) + '"', "longer"),
    "long in UTF-8": ('root ::= "' + "ü" * (1 << 19) + '"', "longer"),
    "rules": ("".join(f"r{index} ::= r{index + 1}\n" for index in range(20_000)), "rules"),
    "repetition": ('root ::= "a"{1,1000000000}', "repeats"),
    "repetition of repetitions": ('root ::= ((("a"{1000}){1000}){1000})', "repeats"),
    "repetition of one": ('root ::= "a"{200}{200}', "repeats"),
    "huge number": ('root ::= "a"{' + "9" * 10_000 + "}", "repeats"),
}


@pytest.mark.parametrize(("text", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_grammar_is_refused_with_its_reason(text: str, reason: str) -> None:
    assert reason in beyond_limits(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        'root ::= "' + "(" * 1000 + '"',
        "root ::= [(" + "(" * 1000 + "\\]]",
        "root ::= #" + "(" * 1000 + '\n "a"',
        'root ::= "a\\"" ' + '("b") ' * 1000,
        "root ::= " + "(" * DEPTH + '"a"' + ")" * DEPTH,
        f'root ::= "a"{{{REPETITIONS}}}',
        'root ::= ("a"{100} "b"{100}){100}',
        "root ::= r0\n" + "".join(f'r{index} ::= "a"\n' for index in range(RULES - 1)),
        '")"',
    ],
)
def test_what_is_within_the_limits_is_for_llama_cpp_to_judge(text: str) -> None:
    assert beyond_limits(text) == ""


def test_our_own_grammars_are_within_them() -> None:
    assert beyond_limits(grammar(paper_format(load_skills("driving")), 200)) == ""


LLAMA = """
import sys
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.errors import EngineError
from s2a_bench.types import Request
engine = open_engine(EngineConfig(threads=1))
for text in eval(sys.stdin.read()):
    try:
        list(engine.generate(Request("a", "a", max_tokens=1, grammar=text)))
    except EngineError as error:
        print(str(error)[:300].splitlines()[0])
print("alive", len(list(engine.generate(Request("a", "a", max_tokens=2)))))
"""


@pytest.mark.slow
def test_the_engine_outlives_them_and_what_is_just_within_the_limits() -> None:
    chain = "root ::= r0\n" + "".join(f"r{index} ::= r{index + 1}\n" for index in range(RULES - 2))
    brim = [
        "root ::= " + "(" * DEPTH + '"a"' + ")" * DEPTH,
        chain + f'r{RULES - 2} ::= "a"\n',
        f'root ::= "a"{{0,{REPETITIONS}}}',
        'root ::= ("a"?){0,2000}',
    ]
    texts = repr([text for text, _ in HOSTILE.values()] + brim)
    done = subprocess.run([sys.executable, "-c", LLAMA], input=texts, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("is not valid GBNF") >= len(HOSTILE)
    assert done.stdout.endswith("alive 2\n")
