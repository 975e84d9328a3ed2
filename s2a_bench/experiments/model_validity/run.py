"""How many of a model's skills are valid, with a grammar and without: plans asked of a model in this process."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.model_validity.config import ValidityConfig
from s2a_bench.experiments.model_validity.rows import VALIDITY, ValidityRow
from s2a_bench.inference import Engine, open_engine
from s2a_bench.inference.models import resolve
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.machine import environment
from s2a_bench.plan import Cost, Format, SkillSet, arms, load_skills, prompt, score
from s2a_bench.provenance import NONE, Origins, Provenance
from s2a_bench.store.run import RunWriter
from s2a_bench.types import Request

if TYPE_CHECKING:
    from s2a_bench.progress import Progress

ROOM: Final = 2
"""An answer may have as many times the tokens of the longest plan: without a grammar a model uses more words."""
TEMPLATE_TOKENS: Final = 256
"""What a chat template may put around a prompt."""


@dataclass(frozen=True)
class _Ask:
    """One format, ready to be asked for."""

    name: str
    format: Format
    cost: Cost
    prompt: str
    grammars: dict[str, str]
    max_tokens: int

    def to_manifest(self) -> dict[str, Any]:
        """Return what is asked for."""
        return {
            "name": self.name,
            "skill_set": self.format.skills.name,
            "wording": self.format.name,
            "example": self.format.line(1, self.format.texts[0]),
            "tokens_per_skill": asdict(self.cost),
            "prompt": self.prompt,
            "max_tokens": self.max_tokens,
        }


def run_validity(config: ValidityConfig, output: Path, progress: Progress) -> Path:
    """Ask for all plans and return the run folder; raises S2AError for what a user can mend.

    A model gets the same prompt and the same seeds with the grammar and without. Rows are kept answer by answer.
    """
    skills = load_skills(config.skills)
    progress.stage("reading the model's headers")
    model, mmproj = resolve(config.engine)
    tokenize = Tokenizer(model)
    asks = [_ask(config, name, skills, tokenize) for name in config.tokens_per_skill]
    longest = max(len(tokenize(ask.prompt)) + ask.max_tokens for ask in asks) + TEMPLATE_TOKENS
    chosen = config.engine.but(model=model, mmproj=mmproj, context=max(config.engine.context, longest))
    manifest = {
        "configuration": config.but(engine=chosen).to_manifest(),
        "environment": environment.collect(),
        "seeds": {"sampling": config.seed},
        "formats": [ask.to_manifest() for ask in asks],
    }
    with RunWriter.create(output, "model validity", manifest, (VALIDITY,)) as writer:
        progress.opened(writer.path)
        progress.stage("loading the model")
        with closing(open_engine(chosen)) as engine:
            told = engine.describe()
            writer.update(model=told, provenance=Origins(Provenance.of_engine(told, link=NONE)).to_manifest())
            progress.expect(len(asks) * 2 * config.answers)
            for ask in asks:
                progress.stage(f"{ask.name}: {ask.format.name}")
                for seed in range(config.seed, config.seed + config.answers):
                    for arm in ask.grammars:
                        writer.append(VALIDITY, [_answer(engine, config, ask, arm, seed)])
                        progress.advance()
        return writer.path


def _ask(config: ValidityConfig, name: str, skills: SkillSet, tokenize: Tokenizer) -> _Ask:
    """Word one format for the model."""
    format_ = config.format(name, skills, tokenize)
    cost = format_.cost(tokenize, config.n_skills)
    return _Ask(
        name,
        format_,
        cost,
        prompt(format_, config.n_skills, config.task),
        arms(format_, config.n_skills, tokenize),
        config.max_tokens or ROOM * config.n_skills * cost.most,
    )


def _answer(engine: Engine, config: ValidityConfig, ask: _Ask, arm: str, seed: int) -> ValidityRow:
    """Ask for one plan and read it."""
    request = Request(
        f"{ask.name}-{arm}-{seed}",
        ask.prompt,
        max_tokens=ask.max_tokens,
        grammar=ask.grammars[arm],
        seed=seed,
    )
    pieces = [token.text for token in engine.generate(request)]
    found = score(ask.format, [pieces], config.n_skills)
    return ValidityRow(
        format=ask.name,
        wording=ask.format.name,
        skill_set=ask.format.skills.name,
        n_skills=config.n_skills,
        grammar=bool(ask.grammars[arm]),
        seed=seed,
        tokens=len(pieces),
        cut=len(pieces) == ask.max_tokens,
        lines=found.skills + sum(found.problems.values()),
        skills=found.skills,
        problems=dict(found.problems),
        as_ordered=bool(found.as_ordered),
        text="".join(pieces),
    )
