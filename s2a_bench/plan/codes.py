"""Find texts that are one token each and stay so side by side, to stand for whole calls."""

from __future__ import annotations

import string
from collections.abc import Iterator
from itertools import product

from s2a_bench.plan.formats import Tokenize

_ONE = string.ascii_uppercase + string.ascii_lowercase + string.digits + string.punctuation
_BLANK = " "


def line_codes(count: int, tokenize: Tokenize) -> list[str] | None:
    """Return ``count`` texts that cost two tokens with the end of a line; None where there are not that many."""
    for length in (1, 2):
        found = [text for text in _candidates(length) if len(tokenize(f"{text}\n")) == 2]  # noqa: PLR2004
        if len(found) >= count:
            return found[:count]
    return None


def stream_codes(count: int, tokenize: Tokenize) -> list[str]:
    """Return up to ``count`` texts of one token each; fewer where the vocabulary has no more.

    They need no delimiter: all have the same length, so that no code begins another, and any two of them in a row are
    still the two tokens. A blank before each keeps letters from merging where the tokenizer has words for them;
    tokenizers of bytes have no such tokens, but do not merge either.
    """
    best: list[str] = []
    for blank, length in product((_BLANK, ""), (1, 2)):
        found = _apart(count, tokenize, (blank + text for text in _candidates(length)))
        if len(found) == count:
            return found
        best = max(best, found, key=len)
    return best


def _apart(count: int, tokenize: Tokenize, candidates: Iterator[str]) -> list[str]:
    """Take candidates one by one if they are single tokens that do not merge with one already taken."""
    found: dict[str, int] = {}
    for text in candidates:
        own = tokenize(text)
        if len(own) != 1 or own[0] in found.values():
            continue
        row, ids = [text, text], [*own, *own]
        for other, token in found.items():
            row += [other, text]
            ids += [token, *own]
        if tokenize("".join(row)) == ids:
            found[text] = own[0]
        if len(found) == count:
            break
    return list(found)


def _candidates(length: int) -> Iterator[str]:
    return iter(_ONE) if length == 1 else map("".join, product(string.ascii_letters, repeat=length))
