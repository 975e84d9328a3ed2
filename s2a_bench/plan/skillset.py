"""What a robot can do: skills with arguments out of closed vocabularies, how long each takes, what fills a gap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal, TypeAlias, get_args

Gap: TypeAlias = Literal["stop", "coast", "hold", "cruise"]
"""What the robot does while no skill is valid (POLICY section 3): come to rest, no effort, keep the last command, keep
the speed it set out with."""

GAPS: tuple[Gap, ...] = get_args(Gap)

Value: TypeAlias = str | int | float


@dataclass(frozen=True, slots=True)
class Durations:
    """How long a skill may take, in seconds: 0 < least <= nominal <= most (T_min, T_nom, T_max of the paper)."""

    least_s: float
    nominal_s: float
    most_s: float


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of a skill: its name, and the vocabulary that its value is from."""

    name: str
    vocabulary: str
    values: tuple[Value, ...]

    def __str__(self) -> str:
        return self.name if self.name == self.vocabulary else f"{self.name}: {self.vocabulary}"


@dataclass(frozen=True, slots=True)
class Skill:
    """One thing the robot can do."""

    name: str
    arguments: tuple[Argument, ...]
    durations: Durations
    gap: Gap

    @property
    def signature(self) -> str:
        """Return it as the paper's prompt lists it: ``place(object, location)``."""
        return f"{self.name}({', '.join(map(str, self.arguments))})"


@dataclass(frozen=True, slots=True)
class Call:
    """A skill with a value for every argument; ``str()`` writes it as the paper does: ``place(cup, table)``."""

    skill: Skill
    values: tuple[Value, ...]

    @property
    def arguments(self) -> dict[str, Value]:
        return {argument.name: value for argument, value in zip(self.skill.arguments, self.values, strict=True)}

    def __str__(self) -> str:
        return f"{self.skill.name}({', '.join(map(str, self.values))})"


@dataclass(frozen=True)
class SkillSet:
    """All that a plan may say; ``role`` completes the prompt's "You are a ..."."""

    name: str
    role: str
    gap: Gap
    """What fills a gap before the first skill, and of every skill that says nothing else."""
    skills: tuple[Skill, ...]

    @cached_property
    def calls(self) -> tuple[Call, ...]:
        """Return every call there is: finite, as every vocabulary is closed."""
        return tuple(
            Call(skill, values)
            for skill in self.skills
            for values in product(*(argument.values for argument in skill.arguments))
        )

    @property
    def vocabularies(self) -> dict[str, tuple[Value, ...]]:
        """Return the vocabularies in the order in which skills use them."""
        return {argument.vocabulary: argument.values for skill in self.skills for argument in skill.arguments}
