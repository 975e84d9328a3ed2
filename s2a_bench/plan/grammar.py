"""The GBNF grammar of a plan: exactly N skills of one format, in characters or pinned to the model's tokens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.plan.formats import Format, Tokenize

_Word: TypeAlias = tuple[str, ...] | tuple[int, ...]
"""A line as characters or as token ids."""


_IN_QUOTES, _IN_CLASS = '"\\', "\\[]^-"


@dataclass(frozen=True, slots=True)
class _Alphabet:
    """How GBNF writes what a word is made of."""

    row: Callable[[_Word], str]
    """One symbol after the other."""
    choice: Callable[[_Word], str]
    """One symbol out of several."""


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
        body, alphabet = _words(format_, 1, tokenize)
        return f"root ::= skill{{{n_skills}}}\nskill ::= {_tree(body, alphabet)}\n"
    names: dict[tuple[_Word, ...], str] = {}
    root, rules = [], []
    for number in range(1, n_skills + 1):
        words, alphabet = _words(format_, number, tokenize)
        head = _common(words, longest=min(map(len, words)) - 1)
        tails = tuple(word[head:] for word in words)
        if tails not in names:  # the same after every number, unless a number and what follows it share a token
            names[tails] = f"skill{len(names) or ''}"
            rules.append(f"{names[tails]} ::= {_tree(tails, alphabet)}\n")
        root.append(f"{alphabet.row(words[0][:head])} {names[tails]}" if head else names[tails])
    return f"root ::= {' '.join(root)}\n{''.join(rules)}"


def _words(format_: Format, number: int, tokenize: Tokenize | None) -> tuple[tuple[_Word, ...], _Alphabet]:
    """Return the lines that may stand at a place as words, and how to write their symbols."""
    if tokenize is None:
        return tuple(tuple(line) for line in format_.lines(number)), _CHARACTERS
    return tuple(tuple(tokenize(line)) for line in format_.lines(number)), _TOKENS


def _tree(words: Sequence[_Word], alphabet: _Alphabet) -> str:
    """Return an expression for exactly these words, none of which begins another."""
    head = _common(words, longest=min(map(len, words)))
    first = alphabet.row(words[0][:head])
    if len(words) == 1:
        return first
    by_symbol: dict[str | int, list[_Word]] = {}
    for word in words:
        by_symbol.setdefault(word[head], []).append(word[head:])
    by_tails: dict[tuple[_Word, ...], list[str | int]] = {}
    for symbol, tails in by_symbol.items():
        by_tails.setdefault(tuple(word[1:] for word in tails), []).append(symbol)
    options = []
    for rest, symbols in by_tails.items():
        if len(symbols) == 1:
            options.append(_tree(by_symbol[symbols[0]], alphabet))
        elif rest == ((),):
            options.append(alphabet.choice(tuple(symbols)))  # type: ignore[arg-type]  # all of one kind
        else:
            options.append(f"{alphabet.choice(tuple(symbols))} {_tree(rest, alphabet)}")  # type: ignore[arg-type]
    body = options[0] if len(options) == 1 else f"({' | '.join(options)})"
    return f"{first} {body}".strip()


def _common(words: Sequence[_Word], longest: int) -> int:
    return next((at for at in range(longest) if len({word[at] for word in words}) > 1), longest)


def _escaped(symbols: _Word, special: str) -> str:
    """Return characters with those escaped that mean something where they stand."""
    codes = {ord(char): f"\\x{ord(char):02X}" for char in special} | {ord("\n"): "\\n"}
    return "".join(map(str, symbols)).translate(codes)


_CHARACTERS = _Alphabet(
    row=lambda symbols: f'"{_escaped(symbols, _IN_QUOTES)}"' if symbols else "",
    choice=lambda symbols: f"[{_escaped(symbols, _IN_CLASS)}]",
)
_TOKENS = _Alphabet(
    row=lambda symbols: " ".join(f"<[{symbol}]>" for symbol in symbols),
    choice=lambda symbols: f"({' | '.join(f'<[{symbol}]>' for symbol in symbols)})",
)
