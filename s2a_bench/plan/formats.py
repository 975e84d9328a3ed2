"""An output format: the text of each call, its cost in tokens, and the prompt that requests it.

Labels of calls go from the paper's ``place(cup, table)`` to one letter per name.
"""

from __future__ import annotations

import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from s2a_bench.plan.skillset import Call, Skill, SkillSet, Value

Tokenize: TypeAlias = Callable[[str], list[int]]
"""A model's tokenizer: text to token ids, without special tokens (`s2a_bench.inference.tokenizer` has llama.cpp's)."""

LETTERS = string.ascii_lowercase + string.ascii_uppercase + string.digits

_BLANKS_AT_MARKS = re.compile(r" ?([(),]) ?")
_CALL = re.compile(r"(\w+)\(([^()]*)\)[^()]*")


def normalise(line: str) -> str:
    """Return a line without meaningless blanks: at its ends, doubled, around brackets and commas."""
    return _BLANKS_AT_MARKS.sub(r"\1", " ".join(line.split()))


class CallLabels:
    """Labels as in the paper, ``place(cup, table)``; subclasses have others."""

    name = "calls"
    glue = " "
    """Separator of words, also before a filler."""
    terse = 0
    """0: plain words; above 0 the prompt lists all calls."""

    def spell(self, call: Call) -> str:
        """Return a call's text, without number, filler and delimiter."""
        return str(call)

    def head(self, skill: Skill) -> str | None:
        """Return the label of a skill; None if a label is a whole call."""
        return skill.name

    def value(self, vocabulary: str, value: Value) -> str:  # noqa: ARG002 the same in every vocabulary
        return str(value)

    def fields(self, line: str) -> list[str] | None:
        """Split a normalised line into head, values, fillers; None if it does not have this form."""
        match = _CALL.fullmatch(line)
        if match is None:
            return None
        return [match[1], *(match[2].split(",") if match[2] else [])]


class Words(CallLabels):
    """The same words without brackets: ``place cup table``."""

    name = "words"

    def spell(self, call: Call) -> str:
        return " ".join([call.skill.name, *map(str, call.values)])

    def fields(self, line: str) -> list[str]:
        return line.split()


class Letters(CallLabels):
    """One letter for the skill and one for each value, unique within its vocabulary: ``pct``."""

    name = "letters"
    glue = ""
    terse = 1

    def __init__(self, skills: SkillSet) -> None:
        """Assign a letter to every name and value; raises ValueError if there are too many.

        Numbers get letters in order, because one of their digits would look like the number.
        """
        self._heads = _initials(skill.name for skill in skills.skills)
        self._values = {name: _initials(values) for name, values in skills.vocabularies.items()}

    def spell(self, call: Call) -> str:
        pairs = zip(call.skill.arguments, call.values, strict=True)
        return self.head(call.skill) + "".join(self.value(argument.vocabulary, value) for argument, value in pairs)

    def head(self, skill: Skill) -> str:
        return self._heads[skill.name]

    def value(self, vocabulary: str, value: Value) -> str:
        return self._values[vocabulary][value]

    def fields(self, line: str) -> list[str]:
        return list(line)


class Codes(CallLabels):
    """One code per call with all its arguments: ``A``."""

    name = "codes"
    glue = ""
    terse = 2

    def __init__(self, codes: Mapping[Call, str]) -> None:
        self._codes = codes

    def spell(self, call: Call) -> str:
        return self._codes[call]

    def head(self, skill: Skill) -> None: ...

    def fields(self, line: str) -> list[str]:
        return [line]


def _initials(names: Iterable[Value]) -> dict[Value, str]:
    """Assign each name a unique letter, one of its letters if possible, else the first unused one."""
    letters: dict[Value, str] = {}
    for name in names:
        wanted = [char for char in name if char in LETTERS] if isinstance(name, str) else []
        letter = next((char for char in (*wanted, *LETTERS) if char not in letters.values()), None)
        if letter is None:
            raise ValueError(f"more than {len(LETTERS)} names")
        letters[name] = letter
    return letters


@dataclass(frozen=True)
class Format:
    """The text form of a plan. ``texts`` are those of ``skills.calls``, in their order, fillers included.

    With a delimiter a skill is a line; without one it is a code, and codes follow each other directly.
    """

    name: str
    skills: SkillSet
    labels: CallLabels
    texts: tuple[str, ...]
    numbered: bool = False
    delimiter: str = "\n"

    def __post_init__(self) -> None:
        if len(self.table) != len(self.skills.calls):
            raise ValueError(f"{self.name}: two calls have the same text")

    @cached_property
    def table(self) -> dict[str, int]:
        """Return the index in ``skills.calls`` of each normalised text."""
        return {normalise(text): index for index, text in enumerate(self.texts)}

    def line(self, number: int, text: str) -> str:
        prefix = f"{number}.{self.labels.glue}" if self.numbered else ""
        return f"{prefix}{text}{self.delimiter}"

    def lines(self, number: int) -> list[str]:
        """Return every possible line of that number, in the order of ``skills.calls``."""
        return [self.line(number, text) for text in self.texts]

    def counts(self, tokenize: Tokenize, numbers: Sequence[int]) -> list[int]:
        return [len(tokenize(line)) for number in numbers for line in self.lines(number)]


def spelled(skills: SkillSet, labels: CallLabels, *, numbered: bool) -> Format:
    """Return a format with these labels, without fillers."""
    name = f"numbered {labels.name}" if numbered else labels.name
    return Format(name, skills, labels, tuple(map(labels.spell, skills.calls)), numbered)


def paper_format(skills: SkillSet) -> Format:
    """Return the paper's format (section IV-E): numbered calls, one per line, of any cost."""
    return spelled(skills, CallLabels(), numbered=True)


def prompt(format_: Format, n_skills: int, task: str = "") -> str:
    """Return the prompt; ``task`` is the user's description of the robot's task.

    The sentences are the paper's; vocabularies and the number of skills are added, because the grammar enforces them.
    If calls are not written as the skills are listed, a list of all calls with their codes follows.
    """
    skills = format_.skills
    coded = any(normalise(text) != normalise(str(call)) for text, call in zip(format_.texts, skills.calls, strict=True))
    codes = [f"{text.strip()} = {call}" for text, call in zip(format_.texts, skills.calls, strict=True)]
    lines = [
        f"You are a {skills.role}.",
        f"Skills: {', '.join(skill.signature for skill in skills.skills)}.",
        *(f"{name}: {', '.join(map(str, values))}." for name, values in skills.vocabularies.items()),
        *(["Codes:", *codes] if coded else []),
        f"Rules: Output only {_what(format_, coded=coded)}.",
        f"Output exactly {n_skills} of them.",
        "Do not output any explanation.",
        *([f"Task: {task}"] if task else []),
    ]
    return "\n".join(lines) + "\n"


def _what(format_: Format, *, coded: bool) -> str:
    if not format_.delimiter:
        return f"codes in one line, such as {''.join(format_.texts[:2]).strip()}"
    numbered = "numbered " if format_.numbered else ""
    example = f" such as {format_.line(1, format_.texts[0]).strip()}" if coded else ""
    return f"{numbered}{'codes' if coded else 'skill calls'}{example}, one per line"
