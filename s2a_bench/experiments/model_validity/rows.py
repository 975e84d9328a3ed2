"""The rows of a run that counts valid skills."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class ValidityRow:
    """One answer of a model that was asked for a plan of ``n_skills``, with the grammar or without.

    ``format`` is what was asked for: paper, or tokens a skill; ``wording`` what that is with this model. ``lines`` are
    those that count, the first ``n_skills`` of the answer; ``skills`` the valid ones, ``problems`` the others by kind.
    ``cut`` says that the answer ended because its tokens were used up.
    """

    format: str
    wording: str
    skill_set: str
    n_skills: int
    grammar: bool
    seed: int
    tokens: int
    cut: bool
    lines: int
    skills: int
    problems: dict[str, int]
    as_ordered: bool
    text: str


VALIDITY: Final[Table[ValidityRow]] = Table("validity", ValidityRow)
"""One row an answer that was asked for to see whether its skills are valid."""
