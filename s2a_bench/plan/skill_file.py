"""Read a skill set from TOML, strictly: every error names the file and the key."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from decimal import Decimal
from importlib.resources import files
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from s2a_bench.errors import UsageError
from s2a_bench.plan.skillset import Argument, Gap, Skill, SkillSet, Value
from s2a_bench.text import none_of
from s2a_bench.toml_file import Line, TomlTable, parse, read
from s2a_bench.types import Timing

SKILL_SETS = ("household", "driving")
"""Names of the sets that come with the package, to use or to copy: ``s2a_bench/plan/skills/NAME.toml``."""

MOST_CALLS = 1024
"""Larger sets are refused, because every call is spelled and counted."""

LONGEST_WORD = 64
"""Characters of a name or value."""

LEAST_RATIO, MOST_RATIO = Decimal("0.8"), Decimal("1.5")
"""Defaults of T_min/T_nom and T_max/T_nom."""

_RESERVED = frozenset("(),\ufffd")
"""Characters of the syntax, and the replacement of invalid bytes."""

_LARGEST: Final = 10**9
_RANGE: Final = ("from", "to", "step")


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, Decimal)):
        return False
    number = Decimal(value)
    return number.is_finite() and abs(number) <= _LARGEST


def _number(value: Any) -> Decimal:
    if not _is_number(value):
        raise ValueError("should be a number of at most 1e9")
    return Decimal(value)


def _identifier(name: str) -> str:
    if not name.isidentifier() or len(name) > LONGEST_WORD:
        raise ValueError(f"'{name}' should be letters, digits and underscores, at most {LONGEST_WORD}")
    return name


def _values(content: Any) -> tuple[Value, ...]:
    """Read a list of texts, a list of numbers, or a range ``{ from, to, step }``."""
    values: tuple[Value, ...]
    if isinstance(content, dict):
        values = _range(content)
    elif isinstance(content, list) and content and all(isinstance(value, str) for value in content):
        for text in content:
            if not 0 < len(text) <= LONGEST_WORD:
                raise ValueError(f"'{text}' should have 1 to {LONGEST_WORD} characters")
            if not text.isprintable() or any(char.isspace() or char in _RESERVED for char in text):
                raise ValueError(f"'{text}' should be printable, without blanks, brackets and commas")
        values = tuple(content)
    elif isinstance(content, list) and content and all(_is_number(value) for value in content):
        values = tuple(_plain(Decimal(value)) for value in content)
    else:
        raise ValueError("should be a list of texts, a list of numbers, or { from = 0, to = 60, step = 5 }")
    _refuse_twins(map(str, values))
    return values


def _range(content: Mapping[str, Any]) -> tuple[Value, ...]:
    if set(content) != set(_RANGE) or not all(_is_number(value) for value in content.values()):
        raise ValueError(f"a range has the numbers {', '.join(_RANGE)}, and nothing else")
    first, last, step = (Decimal(content[key]) for key in _RANGE)
    if step <= 0 or last < first:
        raise ValueError("a range needs from <= to and step > 0")
    steps, rest = divmod(last - first, step)
    if rest:
        raise ValueError(f"{last} is not reached from {first} in steps of {step}")
    if steps >= MOST_CALLS:
        raise ValueError(f"{steps + 1} values; at most {MOST_CALLS} calls are allowed, use a coarser step")
    return tuple(_plain(first + index * step) for index in range(int(steps) + 1))


def _plain(value: Decimal) -> int | float:
    return int(value) if value == value.to_integral_value() else float(value)


def _refuse_twins(names: Iterable[str], key: str = "") -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise ValueError(f"{key}'{name}' stands there twice")
        seen.add(name)


Identifier = Annotated[str, AfterValidator(_identifier)]
Number = Annotated[Decimal, BeforeValidator(_number)]
Vocabulary = Annotated[Any, BeforeValidator(_values)]


class _Skill(TomlTable):
    name: Identifier
    arguments: list[str] = Field([])
    t_nom_s: Number
    t_min_s: Number | None = None
    t_max_s: Number | None = None
    gap: Gap | None = None

    @property
    def durations(self) -> tuple[Decimal, Decimal, Decimal]:
        nominal = self.t_nom_s
        least = nominal * LEAST_RATIO if self.t_min_s is None else self.t_min_s
        return least, nominal, nominal * MOST_RATIO if self.t_max_s is None else self.t_max_s

    @model_validator(mode="after")
    def _order(self) -> _Skill:
        least, nominal, most = self.durations
        if not 0 < least <= nominal <= most:
            raise ValueError(f"0 < t_min_s <= t_nom_s <= t_max_s does not hold for {least}, {nominal}, {most}")
        return self


class _SkillFile(TomlTable):
    name: Line
    role: Line
    gap: Gap
    vocabulary: dict[str, Vocabulary] = Field({})
    skill: list[_Skill] = Field(min_length=1)


def load_skills(choice: str) -> SkillSet:
    """Read the shipped set of that name, else the TOML file at that path; raises UsageError."""
    if choice in SKILL_SETS:
        return parse_skills(files("s2a_bench.plan").joinpath("skills", f"{choice}.toml").read_text("utf-8"), choice)
    if not choice.endswith(".toml"):
        raise UsageError(f"`skills`: {none_of(choice, SKILL_SETS, ', and no path of a .toml file')}")
    return parse_skills(read(choice, "skills"), choice)


def parse_skills(text: str, origin: str) -> SkillSet:
    """Read a skill set from TOML text (docs/plans.md has the keys); raises UsageError naming ``origin`` and the key."""
    where = f"`skills` {origin}"
    file = parse(_SkillFile, text, where, Decimal)
    try:
        return _skill_set(file)
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from error


def _skill_set(file: _SkillFile) -> SkillSet:
    skills = tuple(_skill(table, file) for table in file.skill)
    _refuse_twins((skill.name for skill in skills), "skill: ")
    used = {argument.vocabulary for skill in skills for argument in skill.arguments}
    for unused in file.vocabulary.keys() - used:
        raise ValueError(f"vocabulary.{unused}: no skill has an argument of it")
    calls = sum(math.prod(len(argument.values) for argument in skill.arguments) for skill in skills)
    if calls > MOST_CALLS:
        raise ValueError(f"skill: {calls} calls are possible, at most {MOST_CALLS} are allowed; use coarser steps")
    return SkillSet(file.name, file.role, file.gap, skills)


def _skill(table: _Skill, file: _SkillFile) -> Skill:
    least, nominal, most = map(float, table.durations)
    try:
        arguments = tuple(_argument(text, file.vocabulary) for text in table.arguments)
        _refuse_twins(argument.name for argument in arguments)
    except ValueError as error:
        raise ValueError(f"skill[{table.name}].arguments: {error}") from error
    return Skill(table.name, arguments, Timing(nominal, least, most), table.gap or file.gap)


def _argument(text: str, vocabularies: Mapping[str, tuple[Value, ...]]) -> Argument:
    name, _, vocabulary = text.partition(":")
    vocabulary = vocabulary or name
    _identifier(name)
    if vocabulary not in vocabularies:
        defined = ", ".join(vocabularies) or "none is"
        raise ValueError(f"the vocabulary '{vocabulary}' is not defined ({defined})")
    return Argument(name, vocabulary, vocabularies[vocabulary])
