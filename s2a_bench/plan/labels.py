"""Ways to spell a call, from the paper's ``place(cup, table)`` to one letter a word, and how each is taken apart."""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Mapping

from s2a_bench.plan.skillset import Call, Skill, SkillSet, Value

LETTERS = string.ascii_lowercase + string.ascii_uppercase + string.digits

_BLANKS_AT_MARKS = re.compile(r" ?([(),]) ?")
_CALL = re.compile(r"(\w+)\(([^()]*)\)[^()]*")


def normalise(line: str) -> str:
    """Return a line without the blanks that carry no meaning: at its ends, doubled, around brackets and commas."""
    return _BLANKS_AT_MARKS.sub(r"\1", " ".join(line.split()))


class Calls:
    """How a call is spelled; here as the paper does, ``place(cup, table)``, and otherwise in subclasses."""

    name = "calls"
    glue = " "
    """What stands between words, and before a filler."""
    terse = 0
    """0: plain words; more: further from them, so that a reader needs a list of all calls to know what is meant."""

    def spell(self, call: Call) -> str:
        """Return a call's text, without number, filler and delimiter."""
        return str(call)

    def head(self, skill: Skill) -> str | None:
        """Return what stands for the skill itself; None where one text stands for the whole call."""
        return skill.name

    def value(self, vocabulary: str, value: Value) -> str:  # noqa: ARG002 the same in every vocabulary
        """Return what stands for a value."""
        return str(value)

    def fields(self, line: str) -> list[str] | None:
        """Take a normalised line apart: head, values, fillers; None where it does not have this form."""
        match = _CALL.fullmatch(line)
        if match is None:
            return None
        return [match[1], *(match[2].split(",") if match[2] else [])]


class Words(Calls):
    """The same words without brackets: ``place cup table``."""

    name = "words"

    def spell(self, call: Call) -> str:
        return " ".join([call.skill.name, *map(str, call.values)])

    def fields(self, line: str) -> list[str]:
        return line.split()


class Letters(Calls):
    """One letter for the skill and one for each value, unique within its vocabulary: ``pct``."""

    name = "letters"
    glue = ""
    terse = 1

    def __init__(self, skills: SkillSet) -> None:
        """Give every word a letter, the first of its own that is free; raises ValueError where letters run out.

        Numbers get letters in order: a digit of their own would be taken for the number.
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


class Codes(Calls):
    """One text for a call with all its arguments: ``A``."""

    name = "codes"
    glue = ""
    terse = 2

    def __init__(self, codes: Mapping[Call, str]) -> None:
        self._codes = codes

    def spell(self, call: Call) -> str:
        return self._codes[call]

    def head(self, skill: Skill) -> None:
        """Return None: no part of a code stands for the skill."""

    def fields(self, line: str) -> list[str]:
        return [line]


def _initials(words: Iterable[Value]) -> dict[Value, str]:
    """Give each word a letter that no other has: one of its own where possible, else the first that is free."""
    found: dict[Value, str] = {}
    for word in words:
        wanted = [char for char in word if char in LETTERS] if isinstance(word, str) else []
        letter = next((char for char in (*wanted, *LETTERS) if char not in found.values()), None)
        if letter is None:
            raise ValueError(f"more than {len(LETTERS)} words")
        found[word] = letter
    return found
