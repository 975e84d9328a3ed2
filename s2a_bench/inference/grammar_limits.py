"""Which GBNF grammars llama.cpp may see: its parser recurses without limit, and a deep one ends the process."""

from __future__ import annotations

import re

GRAMMAR_BYTES = 1 << 20
DEPTH = 200
"""Of parentheses in each other."""
RULES = 5_000
"""llama.cpp also recurses along rules that name each other."""
REPETITIONS = 10_000
"""Of braces in each other, multiplied: llama.cpp writes out what is repeated."""

_DIGITS = 6
_LEXEME = re.compile(r'"(?:\\.|[^"\\])*"?|\[(?:\\.|[^\]\\])*\]?|#[^\n]*|\{([^}]*)\}?|[()]', re.DOTALL)
"""What is left open goes on to the end, so that no text is read twice."""


def beyond_limits(grammar: str) -> str:
    """Return by what a grammar is beyond what llama.cpp survives, "" if it is not."""
    if len(grammar) > GRAMMAR_BYTES or len(grammar.encode(errors="replace")) > GRAMMAR_BYTES:
        return f"it is longer than {GRAMMAR_BYTES} bytes"
    if "\0" in grammar:
        return "it has a NUL"
    if grammar.count("::=") > RULES:
        return f"it has more than {RULES} rules"
    repeated, last = [1], 1  # the most that anything is repeated in each open parenthesis, and the last thing was
    for lexeme in _LEXEME.finditer(grammar):
        said, times = lexeme[0], 1
        if said == "(":
            repeated.append(1)
        elif said == ")" and len(repeated) > 1:
            times = repeated.pop()
        elif lexeme[1] is not None:
            times = last * _most(lexeme[1])
        last = times
        repeated[-1] = max(repeated[-1], times)
        if len(repeated) > DEPTH + 1:
            return f"it nests deeper than {DEPTH} parentheses"
        if times > REPETITIONS:
            return f"it repeats something more than {REPETITIONS} times"
    return ""


def _most(braces: str) -> int:
    """Return the largest number in braces, at least 1."""
    numbers = re.findall(r"\d+", braces)
    return max([1, *(int(digits) if len(digits) <= _DIGITS else REPETITIONS + 1 for digits in numbers)])
