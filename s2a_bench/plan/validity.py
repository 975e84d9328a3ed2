"""How many of a model's skills are valid: the paper's hallucination control (section IV-E), measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from s2a_bench.plan.formats import Format, Tokenize
from s2a_bench.plan.grammar import grammar
from s2a_bench.plan.parser import Parser, SkillParsed

Ask: TypeAlias = Callable[[str, int], Iterable[str]]
"""Generate an answer under a GBNF grammar ("" for none) with a seed; yields its text in any pieces, as it comes."""


@dataclass(frozen=True, slots=True)
class Validity:
    """What a parser found in some answers."""

    answers: int
    skills: int
    """Valid ones."""
    problems: Mapping[str, int]
    """Bad lines by their kind."""
    as_ordered: int
    """Answers with exactly the wanted number of skills and no bad line."""

    @property
    def share(self) -> float | None:
        """Return valid skills over all lines that are not empty; None where there was none."""
        lines = self.skills + sum(self.problems.values())
        return self.skills / lines if lines else None


def score(format_: Format, answers: Iterable[Iterable[str]], n_skills: int) -> Validity:
    """Parse answers, each given in pieces, of which ``n_skills`` skills were wanted.

    The first ``n_skills`` lines of an answer count, skills or not: one that goes on is not as ordered, but does not
    weigh more for it.
    """
    count = skills = as_ordered = 0
    problems: Counter[str] = Counter()
    for pieces in answers:
        parser = Parser(format_)
        events = [event for piece in pieces for event in parser.feed(piece)] + parser.close()
        count += 1
        as_ordered += len(events) == n_skills and all(isinstance(event, SkillParsed) for event in events)
        for event in events[:n_skills]:
            if isinstance(event, SkillParsed):
                skills += 1
            else:
                problems[event.problem] += 1
    return Validity(count, skills, dict(problems), as_ordered)


def arms(format_: Format, n_skills: int, tokenize: Tokenize | None = None) -> dict[str, str]:
    """Return the GBNF grammar of each way to ask: "grammar", and "free" with none."""
    return {"grammar": grammar(format_, n_skills, tokenize), "free": ""}


def measure_validity(
    ask: Ask, format_: Format, n_skills: int, *, answers: int = 32, tokenize: Tokenize | None = None
) -> dict[str, Validity]:
    """Ask for plans with the grammar and without, seeds 0, 1, ..., and return what was valid, by "grammar" and "free".

    ``tokenize`` pins the grammar to the model's tokens, as in `grammar`.
    """
    return {
        name: score(format_, (ask(text, seed) for seed in range(answers)), n_skills)
        for name, text in arms(format_, n_skills, tokenize).items()
    }
