"""Which model is asked for which plans, and how often."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, Options, TextOrFile, group, option

if TYPE_CHECKING:
    from s2a_bench.inference.tokenizer import Tokenizer
    from s2a_bench.plan import Format, SkillSet

PAPER: Final = "paper"
"""The paper's format, among the tokens a skill that are asked for."""


class ValidityConfig(Options):
    """Which model is asked for which plans, and how often."""

    engine: EngineConfig = group(EngineConfig, only=("model", "mmproj", "threads", "gpu_layers"))
    skills: str = option("household", "household, driving, or a TOML file")
    tokens_per_skill: Names = option(
        (PAPER,), f"formats: {PAPER}, or tokens a skill; several with commas, as {PAPER},6,4,2,1"
    )
    n_skills: int = option(8, "N, skills a plan", ge=1, le=100)
    answers: int = option(32, "answers of each format, with the grammar and without", ge=1, le=1_000_000)
    task: TextOrFile = option("", "what the robot should do; @FILE reads it")
    max_tokens: int | None = option(
        None, "the most tokens of an answer [default: twice those of the longest plan]", ge=1
    )
    seed: int = option(0, "seed of the first answer; each further one has the next", ge=0)

    def check(self) -> None:
        """Refuse formats that there are not; raises UsageError naming the field."""
        if not self.tokens_per_skill:
            raise UsageError(f"`tokens_per_skill`: name at least one, as {PAPER},6,1")
        for name in self.tokens_per_skill:
            if name != PAPER and not name.isdecimal():
                raise UsageError(f"`tokens_per_skill`: '{name}' should be {PAPER} or a whole number")

    def format(self, name: str, skills: SkillSet, tokenize: Tokenizer) -> Format:
        """Return the format that costs so many tokens a skill; raises UsageError where the model has none."""
        from s2a_bench.plan import choose_format, paper_format

        return paper_format(skills) if name == PAPER else choose_format(skills, int(name), tokenize, self.n_skills)
