"""Turn a model's answer into skills while it arrives: no I/O, pieces of any length, in the manner of h11.

Rules of this file:
- A skill is certain, and emitted, at its delimiter; in a format without delimiter, at the last byte of its code. It is
  not emitted earlier, even if a grammar allows one continuation only: without one ``go_to(kitchen)`` may continue.
- At the end of the stream the last line counts as complete if no other line begins with it (``speed 5`` may be the
  start of ``speed 50``).
- Blanks at the ends of a line, doubled, or around brackets and commas are ignored, and so are empty lines.
- A numbered format requires a number before each call; its value is ignored: the order is that of arrival.
- Anything else is a `BadLine`, and reading continues at the next line; without a delimiter, after the next blank. Codes
  written with blanks between must have them, so that prose is not read as codes letter by letter.
- Bytes that are not UTF-8, and lone surrogates, become U+FFFD, which no skill contains. At most one line is kept.
"""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from typing import Literal, TypeAlias

from s2a_bench.plan.formats import Format, normalise
from s2a_bench.plan.skillset import Call

Problem: TypeAlias = Literal["unknown-skill", "bad-argument", "malformed", "too-long", "incomplete"]


@dataclass(frozen=True, slots=True)
class SkillParsed:
    """The next skill of the plan is certain."""

    index: int
    """Skills before it, from 0."""
    call: Call
    line: int
    """Lines before it that are not empty, bad ones included; in a format without delimiter, codes and bad runs."""
    piece: int
    """The call of `Parser.feed` that completed it, from 0; `Parser.close` counts as the call after the last.

    Fed one token at a time, this is the token whose arrival is t_i.
    """


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line that is not a skill. ``text`` is cut if the line is too long."""

    problem: Problem
    text: str
    why: str
    line: int
    piece: int


Event: TypeAlias = SkillParsed | BadLine


class Parser:
    def __init__(self, format_: Format) -> None:
        self._format = format_
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._reader = _Lines(format_) if format_.delimiter else _Codes(format_)
        self._skills = self._lines = 0
        self._feeds = -1
        self._closed = False

    def feed(self, piece: str | bytes) -> list[Event]:
        """Read the next piece of the answer, of any length, and return the events that it makes certain.

        Pass bytes if a piece may end within a character. Raises ValueError after `close`.
        """
        if self._closed:
            raise ValueError("the parser is closed; make a new one for another answer")
        data = piece.encode(errors="surrogatepass") if isinstance(piece, str) else piece
        self._feeds += 1
        return self._events(self._reader.read(self._decoder.decode(data)))

    def close(self) -> list[Event]:
        """End the answer and return the last events; nothing the second time."""
        if self._closed:
            return []
        self._closed = True
        self._feeds += 1
        return self._events(self._reader.read(self._decoder.decode(b"", final=True)) + self._reader.end())

    def _events(self, results: list[_Parsed]) -> list[Event]:
        events: list[Event] = []
        for result in results:
            if isinstance(result, int):
                call = self._format.skills.calls[result]
                events.append(SkillParsed(self._skills, call, self._lines, self._feeds))
                self._skills += 1
            else:
                problem, text, why = result
                events.append(BadLine(problem, text, why, self._lines, self._feeds))
            self._lines += 1
        return events


_Bad: TypeAlias = tuple[Problem, str, str]
"""Problem, text and reason of a `BadLine`."""
_Parsed: TypeAlias = int | _Bad
"""An index in ``skills.calls``, or an error."""


class _Lines:
    def __init__(self, format_: Format) -> None:
        self._format = format_
        self._limit = 64 + 2 * max(map(len, format_.texts))
        """Characters; the margin is for blanks and a number."""
        self._line = ""
        self._skipping = False

    def read(self, text: str) -> list[_Parsed]:
        results: list[_Parsed] = []
        start = 0
        while True:
            end = text.find(self._format.delimiter, start)
            results += self._collect(text, start, len(text) if end < 0 else end)
            if end < 0:
                return results
            results += self._finish()
            start = end + len(self._format.delimiter)

    def end(self) -> list[_Parsed]:
        line = self._line.strip()
        text = "" if self._format.numbered and line.isdecimal() else _text(line, self._format)
        if line and text is not None:
            longer = next((key for key in self._format.table if key.startswith(text) and key != text), None)
            if longer is not None:
                return [("incomplete", line, f"the answer ended where '{longer}' was still possible")]
        return self._finish()

    def _collect(self, text: str, start: int, end: int) -> list[_Parsed]:
        if self._skipping:
            return []
        self._line += text[start : min(end, start + self._limit + 1)]
        if len(self._line) <= self._limit:
            return []
        cut, self._line, self._skipping = self._line[: self._limit], "", True
        return [("too-long", cut, f"more than {self._limit} characters without the end of a line")]

    def _finish(self) -> list[_Parsed]:
        line, self._line, self._skipping = self._line.strip(), "", False
        return [_look_up(line, self._format)] if line else []


class _Codes:
    """Reads a format without delimiter: codes of which none begins another."""

    def __init__(self, format_: Format) -> None:
        self._format = format_
        self._starts = {code[:length] for code in format_.table for length in range(1, len(code))}
        self._apart = format_.texts[0][:1].isspace()
        self._code = ""
        self._skipping = self._after_code = False

    def read(self, text: str) -> list[_Parsed]:
        results: list[_Parsed] = []
        for char in text:
            if char.isspace():
                if self._code:
                    results.append(_look_up(self._code, self._format))
                self._code, self._skipping, self._after_code = "", False, False
            elif not self._skipping:
                results += self._take(char)
        return results

    def _take(self, char: str) -> list[_Parsed]:
        if self._after_code and self._apart:
            self._skipping = True
            return [("malformed", char, "codes should be apart")]
        self._code += char
        self._after_code = self._code in self._format.table
        if not self._after_code and self._code in self._starts:
            return []
        code, self._code = self._code, ""
        self._skipping = not self._after_code
        return [_look_up(code, self._format)]

    def end(self) -> list[_Parsed]:
        if not self._code:
            return []
        return [("incomplete", self._code, "the answer ended within a code")]


def _text(line: str, format_: Format) -> str | None:
    """Return a line without its number and meaningless blanks; None if the number is missing."""
    if not format_.numbered:
        return normalise(line)
    number, dot, text = line.partition(".")
    return normalise(text) if dot and number.isascii() and number.isdecimal() else None


def _look_up(line: str, format_: Format) -> _Parsed:
    text = _text(line, format_)
    if text is None:
        return "malformed", line, "a number and a dot should come first"
    index = format_.table.get(text)
    return _explain(text, line, format_) if index is None else index


def _explain(text: str, line: str, format_: Format) -> _Bad:
    labels = format_.labels
    fields = labels.fields(text)
    if not fields:
        return "malformed", line, f"should look like '{format_.texts[0].strip()}'"
    head, *rest = fields
    skill = next((skill for skill in format_.skills.skills if labels.head(skill) == head), None)
    if skill is None:
        return "unknown-skill", line, f"'{head}' is not one of the skills"
    for argument, field in zip(skill.arguments, rest, strict=False):
        if field not in {labels.value(argument.vocabulary, value) for value in argument.values}:
            return "bad-argument", line, f"'{field}' is not a valid {argument.name} of {skill.name}"
    if len(rest) < len(skill.arguments):
        return "bad-argument", line, f"{skill.name} has {len(skill.arguments)} arguments, {len(rest)} are given"
    return "malformed", line, f"{skill.name} is not written as listed"
