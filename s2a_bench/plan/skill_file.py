"""Read a skill set from TOML, strictly: every error names the file and the key."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping
from decimal import Decimal
from importlib.resources import files
from pathlib import Path
from typing import Any

from s2a_bench.errors import UsageError
from s2a_bench.plan.skillset import GAPS, Argument, Durations, Gap, Skill, SkillSet, Value

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SKILL_SETS = ("household", "driving")
"""Names of the sets that come with the package, to use or to copy: ``s2a_bench/plan/skills/NAME.toml``."""

MOST_CALLS = 1024
"""A set with more calls than this is refused: every call is spelled and counted."""

LONGEST_WORD = 64
"""Characters of a name or value."""

LEAST_RATIO, MOST_RATIO = 0.8, 1.5
"""T_min/T_nom and T_max/T_nom where a file leaves them out (POLICY section 3)."""

_RESERVED = frozenset("(),\ufffd")
"""What calls are written with, and what the parser puts where bytes are no text."""


def load_skills(choice: str) -> SkillSet:
    """Read the shipped set of that name, else the TOML file at that path; raises UsageError.

    The one place of this package that opens a file.
    """
    if choice in SKILL_SETS:
        return parse_skills(files("s2a_bench.plan").joinpath("skills", f"{choice}.toml").read_text("utf-8"), choice)
    if not choice.endswith(".toml"):
        raise UsageError(f"--skills: '{choice}' is none of {', '.join(SKILL_SETS)}, and no path of a .toml file")
    try:
        text = Path(choice).read_text("utf-8")
    except OSError as error:
        raise UsageError(f"--skills: cannot read {choice} ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"--skills {choice}: not UTF-8 text ({error.reason} at byte {error.start})") from error
    return parse_skills(text, choice)


def parse_skills(text: str, origin: str) -> SkillSet:
    """Read a skill set from TOML text; docs/plans.md has the keys.

    Raises UsageError that names ``origin``, the file's path for the user, and the key.
    """
    try:
        content = tomllib.loads(text, parse_float=Decimal)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"--skills {origin}: not TOML: {error}") from error
    top = _Table(content, origin, "")
    name, role, gap = top.text("name"), top.text("role"), top.gap()
    vocabularies = {
        key: _vocabulary(value, top, f"vocabulary.{key}")
        for key, value in top.take("vocabulary", dict, "a table", {}).items()
    }
    tables = top.take("skill", list, "an array of tables [[skill]]")
    top.finish()
    if not tables:
        raise top.wrong("skill", "needs at least one [[skill]]")
    skills = tuple(_skill(table, index, origin, vocabularies, gap) for index, table in enumerate(tables))
    _refuse_twins((skill.name for skill in skills), top, "skill.name")
    used = {argument.vocabulary for skill in skills for argument in skill.arguments}
    for unused in vocabularies.keys() - used:
        raise top.wrong(f"vocabulary.{unused}", "no skill has an argument of it")
    calls = sum(math.prod(len(argument.values) for argument in skill.arguments) for skill in skills)
    if calls > MOST_CALLS:
        raise top.wrong("skill", f"{calls} calls are possible, at most {MOST_CALLS} are allowed; use coarser steps")
    return SkillSet(name, role, gap, skills)


class _Table:
    """A TOML table of which every key must be taken."""

    def __init__(self, content: Mapping[str, Any], origin: str, path: str) -> None:
        self._content = dict(content)
        self._origin = origin
        self._path = path

    def wrong(self, key: str, what: str) -> UsageError:
        return UsageError(f"--skills {self._origin}: {self._path}{key}: {what}")

    def take(self, key: str, kind: type | tuple[type, ...], words: str, default: Any = None) -> Any:
        """Return a key's value, which must be of a kind; without a default it must be there."""
        if key not in self._content:
            if default is None:
                raise self.wrong(key, f"is missing; it should be {words}")
            return default
        value = self._content.pop(key)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise self.wrong(key, f"should be {words}")
        return value

    def text(self, key: str) -> str:
        value: str = self.take(key, str, "a text")
        if not value.strip() or not value.isprintable():
            raise self.wrong(key, "should be a text of one line")
        return value

    def gap(self, default: Gap | None = None) -> Gap:
        value = self.take("gap", str, f"one of {', '.join(GAPS)}", default)
        for gap in GAPS:
            if gap == value:
                return gap
        raise self.wrong("gap", f"'{value}' is none of {', '.join(GAPS)}")

    def number(self, key: str, default: Decimal | None = None) -> Decimal:
        value = Decimal(self.take(key, (int, Decimal), "a number", default))
        if not value.is_finite() or abs(value) > 10**9:
            raise self.wrong(key, "should be a number of at most 1e9")
        return value

    def finish(self) -> None:
        for key in self._content:
            raise self.wrong(key, "no such key; see docs/plans.md")


def _skill(
    content: Any, index: int, origin: str, vocabularies: Mapping[str, tuple[Value, ...]], default_gap: Gap
) -> Skill:
    """Read one ``[[skill]]``."""
    if not isinstance(content, dict):
        raise UsageError(f"--skills {origin}: skill: should be an array of tables [[skill]]")
    table = _Table(content, origin, f"skill[{index}].")
    name = table.text("name")
    _check_name(name, table, "name")
    table = _Table({key: value for key, value in content.items() if key != "name"}, origin, f"skill {name}: ")
    texts = table.take("arguments", list, 'a list such as ["object", "to:location"]', [])
    arguments = tuple(_argument(text, table, vocabularies) for text in texts)
    _refuse_twins((argument.name for argument in arguments), table, "arguments")
    nominal = table.number("t_nom_s")
    least = table.number("t_min_s", nominal * Decimal(str(LEAST_RATIO)))
    most = table.number("t_max_s", nominal * Decimal(str(MOST_RATIO)))
    if not 0 < least <= nominal <= most:
        raise table.wrong("t_nom_s", f"0 < t_min_s <= t_nom_s <= t_max_s does not hold for {least}, {nominal}, {most}")
    gap = table.gap(default_gap)
    table.finish()
    return Skill(name, arguments, Durations(float(least), float(nominal), float(most)), gap)


def _argument(text: Any, table: _Table, vocabularies: Mapping[str, tuple[Value, ...]]) -> Argument:
    """Read ``vocabulary``, or ``name:vocabulary``."""
    if not isinstance(text, str):
        raise table.wrong("arguments", f"{text} should be the name of a vocabulary, or name:vocabulary")
    name, _, vocabulary = text.partition(":")
    vocabulary = vocabulary or name
    _check_name(name, table, "arguments")
    if vocabulary not in vocabularies:
        known = ", ".join(vocabularies) or "none is"
        raise table.wrong("arguments", f"the vocabulary '{vocabulary}' is not defined ({known})")
    return Argument(name, vocabulary, vocabularies[vocabulary])


def _check_name(name: str, table: _Table, path: str) -> None:
    if not name.isidentifier() or len(name) > LONGEST_WORD:
        raise table.wrong(path, f"'{name}' should be letters, digits and underscores, at most {LONGEST_WORD}")


def _vocabulary(content: Any, top: _Table, path: str) -> tuple[Value, ...]:
    """Read a list of texts, a list of numbers, or a range ``{ from, to, step }``."""
    values: tuple[Value, ...]
    if isinstance(content, dict):
        values = _range(content, top, path)
    elif isinstance(content, list) and content and all(isinstance(value, str) for value in content):
        for word in content:
            if not 0 < len(word) <= LONGEST_WORD:
                raise top.wrong(path, f"'{word}' should have 1 to {LONGEST_WORD} characters")
            if not word.isprintable() or any(char.isspace() or char in _RESERVED for char in word):
                raise top.wrong(path, f"'{word}' should be printable, without blanks, brackets and commas")
        values = tuple(content)
    elif isinstance(content, list) and content and all(_is_number(value) for value in content):
        values = tuple(_plain(Decimal(value)) for value in content)
    else:
        raise top.wrong(path, "should be a list of texts, a list of numbers, or { from = 0, to = 60, step = 5 }")
    _refuse_twins(map(str, values), top, path)
    return values


def _range(content: Mapping[str, Any], top: _Table, path: str) -> tuple[Value, ...]:
    for key in ("from", "to", "step"):
        if not _is_number(content.get(key)):
            raise top.wrong(f"{path}.{key}", "should be a number")
    for key in content.keys() - {"from", "to", "step"}:
        raise top.wrong(f"{path}.{key}", "no such key; a range has from, to, step")
    first, last, step = (Decimal(content[key]) for key in ("from", "to", "step"))
    if step <= 0 or last < first:
        raise top.wrong(path, "a range needs from <= to and step > 0")
    steps, rest = divmod(last - first, step)
    if rest:
        raise top.wrong(path, f"{last} is not reached from {first} in steps of {step}")
    if steps >= MOST_CALLS:
        raise top.wrong(path, f"{steps + 1} values; at most {MOST_CALLS} calls are allowed, use a coarser step")
    return tuple(_plain(first + index * step) for index in range(int(steps) + 1))


def _is_number(value: Any) -> bool:
    """Tell whether it is a finite number of ordinary size."""
    if isinstance(value, bool) or not isinstance(value, (int, Decimal)):
        return False
    number = Decimal(value)
    return number.is_finite() and abs(number) <= 10**9


def _plain(value: Decimal) -> int | float:
    """Return an int where the number is whole."""
    return int(value) if value == value.to_integral_value() else float(value)


def _refuse_twins(names: Iterable[str], table: _Table, path: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise table.wrong(path, f"'{name}' stands there twice")
        seen.add(name)
