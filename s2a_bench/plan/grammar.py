"""The GBNF grammar of a plan: exactly N skills of one format, in characters or in the model's tokens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.plan.formats import Format, Tokenize

_Symbols: TypeAlias = tuple[str | int, ...]
"""A line as characters or as token ids."""

_IN_QUOTES, _IN_CLASS = '"\\', "\\[]^-"


def grammar(format_: Format, n_skills: int, tokenize: Tokenize | None = None) -> str:
    """Return GBNF (llama.cpp ``grammars/README.md``) for plans of exactly ``n_skills``; raises UsageError below 1.

    Without a tokenizer it consists of characters, which every llama.cpp and every model supports; the model may then
    use other tokens for the same text than were counted. With the model's tokenizer it consists of token ids
    (``<[220]>``, which llama.cpp of 2025 or older may not support), so every skill has the counted tokens.

    Alternatives form a tree: llama.cpp matches the whole vocabulary against each open alternative.
    """
    if n_skills < 1:
        raise UsageError(f"a plan has at least one skill, not {n_skills}")
    if not format_.numbered:
        return f"root ::= skill{{{n_skills}}}\nskill ::= {_tree(_lines(format_, 1, tokenize))}\n"
    names: dict[tuple[_Symbols, ...], str] = {}
    root, rules = [], []
    for number in range(1, n_skills + 1):
        lines = _lines(format_, number, tokenize)
        head = _common(lines, longest=min(map(len, lines)) - 1)
        tails = tuple(line[head:] for line in lines)
        if tails not in names:  # the same after every number, unless a token includes the number and the next character
            names[tails] = f"skill{len(names) or ''}"
            rules.append(f"{names[tails]} ::= {_tree(tails)}\n")
        root.append(f"{_row(lines[0][:head])} {names[tails]}" if head else names[tails])
    return f"root ::= {' '.join(root)}\n{''.join(rules)}"


def _lines(format_: Format, number: int, tokenize: Tokenize | None) -> list[_Symbols]:
    return [tuple(tokenize(line) if tokenize else line) for line in format_.lines(number)]


def _tree(lines: Sequence[_Symbols]) -> str:
    """Return an expression for exactly these lines, none of which begins another."""
    head = _common(lines, longest=min(map(len, lines)))
    first = _row(lines[0][:head])
    if len(lines) == 1:
        return first
    tails_of: dict[str | int, list[_Symbols]] = {}
    for line in lines:
        tails_of.setdefault(line[head], []).append(line[head + 1 :])
    symbols_before: dict[tuple[_Symbols, ...], list[str | int]] = {}
    for symbol, tails in tails_of.items():
        symbols_before.setdefault(tuple(tails), []).append(symbol)
    options = []
    for rest, symbols in symbols_before.items():
        if len(symbols) == 1:
            options.append(_tree([(symbols[0], *tail) for tail in rest]))
        else:
            options.append(f"{_choice(symbols)} {_tree(rest)}".strip())
    body = options[0] if len(options) == 1 else f"({' | '.join(options)})"
    return f"{first} {body}".strip()


def _common(lines: Sequence[_Symbols], longest: int) -> int:
    return next((at for at in range(longest) if len({line[at] for line in lines}) > 1), longest)


def _row(symbols: Sequence[str | int]) -> str:
    if not symbols or isinstance(symbols[0], int):
        return " ".join(f"<[{symbol}]>" for symbol in symbols)
    return f'"{_escaped(symbols, _IN_QUOTES)}"'


def _choice(symbols: Sequence[str | int]) -> str:
    if isinstance(symbols[0], int):
        return f"({' | '.join(f'<[{symbol}]>' for symbol in symbols)})"
    return f"[{_escaped(symbols, _IN_CLASS)}]"


def _escaped(symbols: Sequence[str | int], special: str) -> str:
    codes = {ord(char): f"\\x{ord(char):02X}" for char in special} | {ord("\n"): "\\n"}
    return "".join(map(str, symbols)).translate(codes)
