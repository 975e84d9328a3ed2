"""An output format: the text that stands for each call, what it costs in tokens, and the prompt that asks for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from s2a_bench.plan.labels import Calls, normalise
from s2a_bench.plan.skillset import Call, SkillSet

Tokenize: TypeAlias = Callable[[str], list[int]]
"""A model's own tokenizer: text to token ids, nothing added (`s2a_bench.inference.tokenizer` has llama.cpp's)."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Tokens a skill, number and delimiter included, over all calls and all numbers of a plan."""

    least: int
    mean: float
    most: int


@dataclass(frozen=True)
class Format:
    """How a plan is written down. ``texts`` are those of ``skills.calls``, in their order, fillers included.

    With a delimiter a skill is a line; without one it is a code, and codes need nothing between them.
    """

    name: str
    skills: SkillSet
    wording: Calls
    texts: tuple[str, ...]
    numbered: bool = False
    delimiter: str = "\n"

    def __post_init__(self) -> None:
        """Refuse two calls that read alike: raises ValueError."""
        if len(self.table) != len(self.skills.calls):
            raise ValueError(f"{self.name}: two calls have the same text")

    @cached_property
    def table(self) -> dict[str, int]:
        """Return where in ``skills.calls`` each text leads, by the texts without meaningless blanks."""
        return {normalise(text): index for index, text in enumerate(self.texts)}

    @cached_property
    def _index(self) -> dict[Call, int]:
        return {call: index for index, call in enumerate(self.skills.calls)}

    def line(self, number: int, text: str) -> str:
        """Return what the model should write for the ``number``-th skill, counted from 1, in order to say ``text``."""
        prefix = f"{number}.{self.wording.glue}" if self.numbered else ""
        return f"{prefix}{text}{self.delimiter}"

    def lines(self, number: int) -> list[str]:
        """Return every line that may stand at that place, in the order of ``skills.calls``."""
        return [self.line(number, text) for text in self.texts]

    def write(self, plan: Iterable[Call]) -> str:
        """Return a whole plan as the model should write it; KeyError for a call that is not of these skills."""
        return "".join(self.line(number, self.texts[self._index[call]]) for number, call in enumerate(plan, 1))

    def cost(self, tokenize: Tokenize, n_skills: int) -> Cost:
        """Count the tokens of every line of plans of up to ``n_skills``; with N > 9 a number may take two."""
        counts = self.counts(tokenize, range(1, n_skills + 1) if self.numbered else (1,))
        return Cost(min(counts), sum(counts) / len(counts), max(counts))

    def counts(self, tokenize: Tokenize, numbers: Sequence[int]) -> list[int]:
        """Return the tokens of each line at each of the places."""
        return [len(tokenize(line)) for number in numbers for line in self.lines(number)]


def spelled(skills: SkillSet, wording: Calls, *, numbered: bool) -> Format:
    """Return a format that spells calls in a wording, without fillers."""
    name = f"numbered {wording.name}" if numbered else wording.name
    return Format(name, skills, wording, tuple(map(wording.spell, skills.calls)), numbered)


def paper_format(skills: SkillSet) -> Format:
    """Return the paper's format (section IV-E): numbered calls, one a line; its cost is what it is."""
    return spelled(skills, Calls(), numbered=True)


def prompt(format_: Format, n_skills: int, task: str = "") -> str:
    """Return what to ask the model; ``task`` is what the robot should do, in the user's words.

    The sentences are the paper's; vocabularies and the number of skills are added, as the grammar holds the model to
    them. Where a call is not written as the skills are listed, every call follows with its code.
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
    """Name what should be written, in the paper's words where they hold."""
    if not format_.delimiter:
        return f"codes in one line, such as {''.join(format_.texts[:2]).strip()}"
    numbered = "numbered " if format_.numbered else ""
    example = f" such as {format_.line(1, format_.texts[0]).strip()}" if coded else ""
    return f"{numbered}{'codes' if coded else 'skill calls'}{example}, one per line"
