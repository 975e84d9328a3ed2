"""Choose the output format with a given number of tokens per skill for a tokenizer."""

from __future__ import annotations

import string
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product

from s2a_bench.errors import UsageError
from s2a_bench.plan.formats import CallLabels, Codes, Format, Letters, Tokenize, Words, spelled
from s2a_bench.plan.skillset import SkillSet

_FILLERS = ("-", "~", "_", ".")
"""Texts without meaning that make a call longer; the tokenizer decides which of them cost a token."""

_ONE = string.ascii_uppercase + string.ascii_lowercase + string.digits + string.punctuation


def choose_format(skills: SkillSet, tokens_per_skill: int, tokenize: Tokenize, n_skills: int = 8) -> Format:
    """Return a format in which *every* call costs exactly that many tokens, number and delimiter included.

    One token: a code without delimiter for each call. More: plain words if they are short enough, else letters, else
    codes, and among these the format with the fewest fillers. ``tokenize`` counts line by line for plans of up to
    ``n_skills``, and once for all calls in a row.

    Raises UsageError if this tokenizer has no such format for these skills; the message has the least possible number.
    """
    if tokens_per_skill < 1:
        raise UsageError(f"`tokens_per_skill`: {tokens_per_skill} should be 1 or more")
    if n_skills < 1:
        raise UsageError(f"a plan has at least one skill, not {n_skills}")
    if tokens_per_skill == 1:
        return _stream(skills, tokenize)
    fitting: list[tuple[int, Format]] = []
    shortest = 0
    for plain in _plain_formats(skills, tokenize):
        most = max(plain.counts(tokenize, (1, n_skills)))
        shortest = min(shortest or most, most)
        padded = _pad(plain, tokens_per_skill, tokenize, n_skills) if most <= tokens_per_skill else None
        if padded:
            fitting.append(padded)
    if not fitting:
        raise UsageError(
            f"`tokens_per_skill` {tokens_per_skill}: no way found to write each of the {len(skills.calls)} calls of "
            f"'{skills.name}' in exactly that many tokens of this model; the shortest lines cost up to {shortest}. "
            "Choose another number, or a smaller skill set"
        )
    return min(fitting, key=lambda entry: (entry[1].labels.terse, entry[0]))[1]


def _stream(skills: SkillSet, tokenize: Tokenize) -> Format:
    calls = skills.calls
    codes = stream_codes(len(calls), tokenize)
    if len(codes) < len(calls):
        raise UsageError(
            f"`tokens_per_skill` 1: '{skills.name}' has {len(calls)} calls, but only {len(codes)} codes of one token "
            "that do not merge were found in this model's vocabulary; use a smaller skill set, or 2 tokens"
        )
    labels = Codes({call: code.strip() for call, code in zip(calls, codes, strict=True)})
    return Format("code stream", skills, labels, tuple(codes), delimiter="")


def _plain_formats(skills: SkillSet, tokenize: Tokenize) -> Iterator[Format]:
    labels: list[CallLabels] = [CallLabels(), Words()]
    with suppress(ValueError):  # too many names for one letter each
        labels.append(Letters(skills))
    for each in labels:
        for numbered in (True, False):
            yield spelled(skills, each, numbered=numbered)
    codes = line_codes(len(skills.calls), tokenize)
    if codes:
        yield spelled(skills, Codes(dict(zip(skills.calls, codes, strict=True))), numbered=False)


def _pad(plain: Format, target: int, tokenize: Tokenize, n_skills: int) -> tuple[int, Format] | None:
    """Add fillers until every call costs the target; return their number of characters, and the format.

    One filler for all calls if possible, else for each call the first that fits.
    """
    if all(count == target for count in plain.counts(tokenize, (1,))):
        return (0, plain) if _holds(plain, target, tokenize, n_skills) else None
    glued = [plain.labels.glue + filler for filler in _FILLERS]
    same = [_filled(plain, [filler], target, tokenize, n_skills) for filler in glued]
    mixed = [*glued, *(f" {filler}" for filler in _FILLERS)]
    filled = same if any(same) else [_filled(plain, mixed, target, tokenize, n_skills)]
    sized = [(sum(map(len, format_.texts)) - sum(map(len, plain.texts)), format_) for format_ in filled if format_]
    return min(sized, key=lambda entry: entry[0], default=None)


def _filled(plain: Format, fillers: Sequence[str], target: int, tokenize: Tokenize, n_skills: int) -> Format | None:
    """Return the format with every call filled up to the target; None if that fails, or makes two texts equal."""
    texts = [_padded(plain, text, fillers, target, tokenize) for text in plain.texts]
    whole = tuple(text for text in texts if text is not None)
    if len(whole) < len(texts):
        return None
    try:
        filled = replace(plain, texts=whole, name=f"{plain.name}, filled up")
    except ValueError:
        return None
    return filled if _holds(filled, target, tokenize, n_skills) else None


def _padded(plain: Format, text: str, fillers: Sequence[str], target: int, tokenize: Tokenize) -> str | None:
    """Return the text with the fewest fillers of one kind for which its line costs the target, if any."""
    for filler in fillers:
        for count in range(2 * target):  # a repeated filler may cost nothing
            padded = text + filler * count
            cost = len(tokenize(plain.line(1, padded)))
            if cost == target:
                return padded
            if cost > target:
                break
    return None


def _holds(form: Format, target: int, tokenize: Tokenize, n_skills: int) -> bool:
    numbers = range(1, n_skills + 1) if form.numbered else (1,)
    if any(count != target for count in form.counts(tokenize, numbers)):
        return False
    row = "".join(form.line(1 + index % n_skills, text) for index, text in enumerate(form.texts))
    return len(tokenize(row)) == target * len(form.texts)


def line_codes(count: int, tokenize: Tokenize) -> list[str] | None:
    """Return ``count`` texts that cost two tokens with the end of a line; None if there are fewer."""
    for length in (1, 2):
        codes = [text for text in _candidates(length) if len(tokenize(f"{text}\n")) == 2]  # noqa: PLR2004
        if len(codes) >= count:
            return codes[:count]
    return None


def stream_codes(count: int, tokenize: Tokenize) -> list[str]:
    """Return up to ``count`` texts of one token each; fewer if the vocabulary has no more.

    They need no delimiter: all have the same length, so no code begins another, and any two of them in a row are the
    same two tokens. A blank before each prevents merges in tokenizers with tokens for words; tokenizers of bytes have
    no such tokens, and do not merge either.
    """
    best: list[str] = []
    for blank, length in product((" ", ""), (1, 2)):
        codes = _apart(count, tokenize, (blank + text for text in _candidates(length)))
        if len(codes) == count:
            return codes
        best = max(best, codes, key=len)
    return best


def _apart(count: int, tokenize: Tokenize, candidates: Iterator[str]) -> list[str]:
    codes: dict[str, int] = {}
    for text in candidates:
        tokens = tokenize(text)
        if len(tokens) != 1 or tokens[0] in codes.values():
            continue
        row, ids = [text, text], [*tokens, *tokens]
        for other, token in codes.items():
            row += [other, text]
            ids += [token, *tokens]
        if tokenize("".join(row)) == ids:
            codes[text] = tokens[0]
        if len(codes) == count:
            break
    return list(codes)


def _candidates(length: int) -> Iterator[str]:
    return iter(_ONE) if length == 1 else map("".join, product(string.ascii_letters, repeat=length))
