"""What an answer means: skills, the text that stands for each call, and the parser that reads it as it comes. Pure.

    skills = load_skills("household")                      # or a path: docs/plans.md
    format_ = choose_format(skills, 4, tokenize, n_skills=8)   # 4 tokens a skill with this model, counted; or
    format_ = paper_format(skills)                         # the paper's, whatever it costs:
    format_.cost(tokenize, 8)                              # Cost(least=5, mean=6.9, most=8)
    text = prompt(format_, 8, "Bring the cup to the table.")
    gbnf = grammar(format_, 8, tokenize)                   # exactly 8 skills, pinned to the model's tokens
    parser = Parser(format_)
    for token in engine.generate(Request("1", text, grammar=gbnf)):
        for event in parser.feed(token.text):              # SkillParsed | BadLine; event.chunk is the token's place
            event.call.skill.durations, event.call.skill.gap, event.call.arguments
    parser.close()

`tokenize` is any function from text to token ids; `s2a_bench.inference.tokenizer.Tokenizer` is the one of a GGUF file.
"""

from s2a_bench.plan.choose import GRANULARITIES, choose_format
from s2a_bench.plan.formats import Cost, Format, Tokenize, paper_format
from s2a_bench.plan.grammar import grammar
from s2a_bench.plan.parser import BadLine, Event, Parser, Problem, SkillParsed
from s2a_bench.plan.prompt import prompt
from s2a_bench.plan.skill_file import SKILL_SETS, load_skills, parse_skills
from s2a_bench.plan.skillset import Argument, Call, Durations, Gap, Skill, SkillSet, Value
from s2a_bench.plan.validity import Ask, Validity, arms, measure_validity, score

__all__ = [
    "GRANULARITIES",
    "SKILL_SETS",
    "Argument",
    "Ask",
    "BadLine",
    "Call",
    "Cost",
    "Durations",
    "Event",
    "Format",
    "Gap",
    "Parser",
    "Problem",
    "Skill",
    "SkillParsed",
    "SkillSet",
    "Tokenize",
    "Validity",
    "Value",
    "arms",
    "choose_format",
    "grammar",
    "load_skills",
    "measure_validity",
    "paper_format",
    "parse_skills",
    "prompt",
    "score",
]
