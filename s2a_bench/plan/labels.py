"""Labels of calls, from the paper's ``place(cup, table)`` to one letter per name, and their parsing."""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Mapping

from s2a_bench.plan.skillset import Call, Skill, SkillSet, Value

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
    found: dict[Value, str] = {}
    for name in names:
        wanted = [char for char in name if char in LETTERS] if isinstance(name, str) else []
        letter = next((char for char in (*wanted, *LETTERS) if char not in found.values()), None)
        if letter is None:
            raise ValueError(f"more than {len(LETTERS)} names")
        found[name] = letter
    return found
