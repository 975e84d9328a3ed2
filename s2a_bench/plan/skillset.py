"""A robot's skills: arguments from closed vocabularies, durations, gap behaviour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal, TypeAlias, get_args

from s2a_bench.types import Timing

Gap: TypeAlias = Literal["stop", "coast", "hold", "cruise"]
"""Behaviour between skills: come to rest, no effort, keep the last command, keep the initial speed."""

GAPS: tuple[Gap, ...] = get_args(Gap)

Value: TypeAlias = str | int | float


@dataclass(frozen=True, slots=True)
class Argument:
    name: str
    vocabulary: str
    values: tuple[Value, ...]

    def __str__(self) -> str:
        return self.name if self.name == self.vocabulary else f"{self.name}: {self.vocabulary}"


@dataclass(frozen=True, slots=True)
class Skill:
    name: str
    arguments: tuple[Argument, ...]
    durations: Timing
    gap: Gap

    @property
    def signature(self) -> str:
        return f"{self.name}({', '.join(map(str, self.arguments))})"


@dataclass(frozen=True, slots=True)
class Call:
    """A skill with a value for every argument; ``str()`` formats it as the paper: ``place(cup, table)``."""

    skill: Skill
    values: tuple[Value, ...]

    @property
    def arguments(self) -> dict[str, Value]:
        return {argument.name: value for argument, value in zip(self.skill.arguments, self.values, strict=True)}

    def __str__(self) -> str:
        return f"{self.skill.name}({', '.join(map(str, self.values))})"


@dataclass(frozen=True)
class SkillSet:
    """The skills of a plan; ``role`` completes the prompt's "You are a ..."."""

    name: str
    role: str
    gap: Gap
    """Behaviour before the first skill, and the default of every skill."""
    skills: tuple[Skill, ...]

    @cached_property
    def calls(self) -> tuple[Call, ...]:
        """Return all calls; vocabularies are closed, so their number is finite."""
        return tuple(
            Call(skill, values)
            for skill in self.skills
            for values in product(*(argument.values for argument in skill.arguments))
        )

    @property
    def vocabularies(self) -> dict[str, tuple[Value, ...]]:
        return {argument.vocabulary: argument.values for skill in self.skills for argument in skill.arguments}
