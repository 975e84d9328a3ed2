"""One format and way to ask as ``--json`` and its schema hold it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from s2a_bench.store.bounds import Count, Fraction, Many, Positive, about

Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Tokens:
    """Counted with the model's tokenizer, number and delimiter included."""

    least: Many
    mean: Positive
    most: Many


@dataclass(frozen=True, kw_only=True)
class ValidityCell:
    """The answers of one format, with the grammar or without."""

    format: Annotated[str, about("What was asked for: paper, or tokens a skill.")]
    wording: Annotated[str, about("How calls are written in it with this model.")]
    example: str
    tokens_per_skill: Tokens
    skill_set: str
    n_skills: Many
    grammar: Annotated[bool, about("Whether a grammar held the model to the plan.")]
    emulated: Literal[False]
    dummy: Annotated[bool, about("Whether the weights are dummies: random.")]
    answers: Many
    cut: Annotated[Count, about("Answers that ended because their tokens were used up.")]
    lines: Annotated[Count, about("Lines that count: the first n_skills of each answer.")]
    skills: Annotated[Count, about("Those that are valid.")]
    problems: Annotated[dict[str, Many], about("The other lines, by kind.")]
    share: Annotated[Fraction | None, about("skills / lines; absent where there is no line.")] = None
    share_ci95: Annotated[
        Interval | None, about("Clopper-Pearson, as if the lines of one answer were independent.")
    ] = None
    as_ordered: Annotated[Count, about("Answers of exactly n_skills valid skills.")]
    as_ordered_share: Fraction
    as_ordered_share_ci95: Annotated[Interval | None, about("Clopper-Pearson.")] = None
