"""Plans in a model's answer: skills, the text of each call, and the parser that reads the answer as it arrives. Pure.

docs/plans.md has an example; `s2a_bench.inference.tokenizer.Tokenizer` is the tokenizer of a GGUF file.
"""

from s2a_bench.plan.choose import choose_format
from s2a_bench.plan.formats import Format, Tokenize, paper_format, prompt
from s2a_bench.plan.grammar import grammar
from s2a_bench.plan.parser import BadLine, Event, Parser, Problem, SkillParsed
from s2a_bench.plan.skill_file import SKILL_SETS, load_skills, parse_skills
from s2a_bench.plan.skillset import Argument, Call, Gap, Skill, SkillSet, Value

__all__ = [
    "SKILL_SETS",
    "Argument",
    "BadLine",
    "Call",
    "Event",
    "Format",
    "Gap",
    "Parser",
    "Problem",
    "Skill",
    "SkillParsed",
    "SkillSet",
    "Tokenize",
    "Value",
    "choose_format",
    "grammar",
    "load_skills",
    "paper_format",
    "parse_skills",
    "prompt",
]
