"""An output format: the text of each call, its cost in tokens, and the prompt that requests it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from s2a_bench.plan.labels import CallLabels, normalise
from s2a_bench.plan.skillset import SkillSet

Tokenize: TypeAlias = Callable[[str], list[int]]
"""A model's tokenizer: text to token ids, without special tokens (`s2a_bench.inference.tokenizer` has llama.cpp's)."""


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
