"""The GBNF grammar of a plan: exactly N skills of one format, in characters or pinned to the model's tokens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.plan.formats import Format, Tokenize

_Word: TypeAlias = tuple[str | int, ...]
"""A line as characters or as token ids."""

_IN_QUOTES, _IN_CLASS = '"\\', "\\[]^-"


def grammar(format_: Format, n_skills: int, tokenize: Tokenize | None = None) -> str:
    """Return GBNF (llama.cpp ``grammars/README.md``) for plans of exactly ``n_skills``; raises UsageError below 1.

    Without a tokenizer it speaks of characters, which every llama.cpp and every model understands; the model may then
    take other tokens for the same text than were counted. With the model's own tokenizer it speaks of token ids
    (``<[220]>``, which a llama.cpp of 2025 or older may not know), so that every skill takes the tokens counted.

    Alternatives form a tree: llama.cpp holds the whole vocabulary against each alternative that is still open.
    """
    if n_skills < 1:
        raise UsageError(f"a plan has at least one skill, not {n_skills}")
    if not format_.numbered:
        return f"root ::= skill{{{n_skills}}}\nskill ::= {_tree(_words(format_, 1, tokenize))}\n"
    names: dict[tuple[_Word, ...], str] = {}
    root, rules = [], []
    for number in range(1, n_skills + 1):
        words = _words(format_, number, tokenize)
        head = _common(words, longest=min(map(len, words)) - 1)
        tails = tuple(word[head:] for word in words)
        if tails not in names:  # the same after every number, unless a number and what follows it share a token
            names[tails] = f"skill{len(names) or ''}"
            rules.append(f"{names[tails]} ::= {_tree(tails)}\n")
        root.append(f"{_row(words[0][:head])} {names[tails]}" if head else names[tails])
    return f"root ::= {' '.join(root)}\n{''.join(rules)}"


def _words(format_: Format, number: int, tokenize: Tokenize | None) -> list[_Word]:
    return [tuple(tokenize(line) if tokenize else line) for line in format_.lines(number)]


def _tree(words: Sequence[_Word]) -> str:
    """Return an expression for exactly these words, none of which begins another."""
    head = _common(words, longest=min(map(len, words)))
    first = _row(words[0][:head])
    if len(words) == 1:
        return first
    tails_of: dict[str | int, list[_Word]] = {}
    for word in words:
        tails_of.setdefault(word[head], []).append(word[head + 1 :])
    symbols_before: dict[tuple[_Word, ...], list[str | int]] = {}
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


def _common(words: Sequence[_Word], longest: int) -> int:
    return next((at for at in range(longest) if len({word[at] for word in words}) > 1), longest)


def _row(symbols: Sequence[str | int]) -> str:
    """Write one symbol after the other."""
    if not symbols or isinstance(symbols[0], int):
        return " ".join(f"<[{symbol}]>" for symbol in symbols)
    return f'"{_escaped(symbols, _IN_QUOTES)}"'


def _choice(symbols: Sequence[str | int]) -> str:
    """Write one symbol out of several."""
    if isinstance(symbols[0], int):
        return f"({' | '.join(f'<[{symbol}]>' for symbol in symbols)})"
    return f"[{_escaped(symbols, _IN_CLASS)}]"


def _escaped(symbols: Sequence[str | int], special: str) -> str:
    """Return characters with those escaped that mean something where they stand."""
    codes = {ord(char): f"\\x{ord(char):02X}" for char in special} | {ord("\n"): "\\n"}
    return "".join(map(str, symbols)).translate(codes)
