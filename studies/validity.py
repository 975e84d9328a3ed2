"""The share of valid skills of a model, with a grammar and without: plans of a model in this process.

The table gives the shares of valid skills and of answers as ordered, the paper's control of hallucinations.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.inference.models import resolve
from s2a_bench.machine import environment
from s2a_bench.options import Names, Options, TextOrFile, group, option
from s2a_bench.plan import (
    Format,
    Parser,
    SkillParsed,
    SkillSet,
    Tokenize,
    choose_format,
    grammar,
    load_skills,
    paper_format,
    prompt,
)
from s2a_bench.policy.conformal import upper_bound
from s2a_bench.provenance import NONE, Origins, Provenance
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import Table
from s2a_bench.types import Request
from s2a_bench.writers.tables import ABSENT, DUMMY, Note, TextTable
from studies import output

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.inference.tokenizer import Tokenizer
    from s2a_bench.progress import Progress
    from s2a_bench.store.run import StoredRun


@dataclass(frozen=True, slots=True)
class Cost:
    """Tokens per skill, number and delimiter included, over all calls and all numbers of a plan."""

    least: int
    mean: float
    most: int


def cost_of(format_: Format, tokenize: Tokenize, n_skills: int) -> Cost:
    """Count the tokens of every line of plans of up to ``n_skills``; with N > 9 a number may take two."""
    counts = format_.counts(tokenize, range(1, n_skills + 1) if format_.numbered else (1,))
    return Cost(min(counts), sum(counts) / len(counts), max(counts))


PAPER: Final = "paper"
"""The paper's format, among the requested tokens a skill."""
ROOM: Final = 2
"""An answer may have as many times the tokens of the longest plan: without a grammar a model uses more words."""
TEMPLATE_TOKENS: Final = 256
"""What a chat template may put around a prompt."""
TAIL: Final = 0.975
"""Each end of a two-sided 95 % interval."""


class ValidityConfig(Options):
    """The model, the plans, and how often."""

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
        return paper_format(skills) if name == PAPER else choose_format(skills, int(name), tokenize, self.n_skills)


@dataclass(frozen=True, slots=True)
class ValidityRow:
    """One answer of a model to the request of a plan of ``n_skills``, with the grammar or without.

    ``format`` is the requested one: paper, or tokens a skill; ``wording`` what that is with this model. ``lines`` are
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
"""One row an answer."""


@dataclass(frozen=True)
class _Ask:
    """One format and its prompt."""

    name: str
    format: Format
    cost: Cost
    prompt: str
    grammars: dict[str, str]
    max_tokens: int

    def to_manifest(self) -> dict[str, Any]:
        """Return the prompt."""
        return {
            "name": self.name,
            "skill_set": self.format.skills.name,
            "wording": self.format.name,
            "example": self.format.line(1, self.format.texts[0]),
            "tokens_per_skill": asdict(self.cost),
            "prompt": self.prompt,
            "max_tokens": self.max_tokens,
        }


def run_validity(config: ValidityConfig, folder: Path, progress: Progress) -> Path:
    """Ask for all plans and return the run folder; raises S2AError for an error that the user can fix.

    A model gets the same prompt and the same seeds with the grammar and without. Rows are kept answer by answer.
    """
    from s2a_bench.inference.tokenizer import Tokenizer  # needs an extra, which no other study does

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
    with RunWriter.create(folder, "validity", manifest, (VALIDITY,)) as writer:
        progress.opened(writer.path)
        progress.stage("loading the model")
        with closing(open_engine(chosen)) as engine:
            facts = engine.describe()
            writer.update(model=facts, provenance=Origins(Provenance.of_engine(facts, link=NONE)).to_manifest())
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
    cost = cost_of(format_, tokenize, config.n_skills)
    return _Ask(
        name,
        format_,
        cost,
        prompt(format_, config.n_skills, config.task),
        {"grammar": grammar(format_, config.n_skills, tokenize), "free": ""},
        config.max_tokens or ROOM * config.n_skills * cost.most,
    )


@dataclass(frozen=True, slots=True)
class Score:
    """What a parser found in one answer."""

    skills: int
    """Valid ones."""
    problems: dict[str, int]
    """Bad lines by their kind."""
    as_ordered: bool
    """Whether it has exactly the wanted number of skills and no bad line."""


def score(format_: Format, pieces: Iterable[str], n_skills: int) -> Score:
    """Parse an answer, given in pieces, of which ``n_skills`` skills were wanted.

    Its first ``n_skills`` lines count, skills or not: one that goes on is not as ordered, but does not weigh more.
    """
    parser = Parser(format_)
    events = [event for piece in pieces for event in parser.feed(piece)] + parser.close()
    counted = events[:n_skills]
    problems: Counter[str] = Counter(event.problem for event in counted if not isinstance(event, SkillParsed))
    as_ordered = len(events) == n_skills and all(isinstance(event, SkillParsed) for event in events)
    return Score(len(counted) - problems.total(), dict(problems), as_ordered)


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
    found = score(ask.format, pieces, config.n_skills)
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
        problems=found.problems,
        as_ordered=bool(found.as_ordered),
        text="".join(pieces),
    )


@dataclass(frozen=True, slots=True)
class Share:
    """So many of so many."""

    count: int
    of: int

    @property
    def value(self) -> float | None:
        """Return the share; None of nothing."""
        return self.count / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Return the two-sided 95 % interval of Clopper and Pearson (Biometrika 1934); None of nothing."""
        if not self.of:
            return None
        return 1 - upper_bound(self.of - self.count, self.of, TAIL), upper_bound(self.count, self.of, TAIL)

    def __str__(self) -> str:
        """Write the share with its interval, in percent."""
        if (value := self.value) is None or (ends := self.interval) is None:
            return ABSENT
        return f"{100 * value:.1f} [{100 * ends[0]:.1f}, {100 * ends[1]:.1f}]"


@dataclass(frozen=True, slots=True)
class Arm:
    """The answers of one format, with the grammar or without."""

    about: dict[str, Any]
    """The format as the manifest has it."""
    grammar: bool
    answers: int
    valid: Share
    """Skills among the lines that count."""
    as_ordered: Share
    """Answers that are exactly the wanted number of skills."""
    cut: int
    problems: dict[str, int] = field(default_factory=dict)


def arms_of(run: StoredRun) -> list[Arm]:
    """Count a run's answers."""
    rows = run.table(VALIDITY)
    formats = {about["name"]: about for about in run.manifest["formats"]}
    return [
        _arm(formats[str(name)], bool(grammar), part)
        for (name, grammar), part in rows.groupby(["format", "grammar"], sort=False)
    ]


def validity_tables(run: StoredRun) -> dict[str, TextTable]:
    """Return every table of a run by its file's name."""
    arms = arms_of(run)
    tables = {"validity": _shares(run, arms), "formats": _formats(run)}
    if kinds := list(dict.fromkeys(kind for arm in arms for kind in arm.problems)):
        lines = [(*_names(arm), *(str(arm.problems.get(kind, 0)) for kind in kinds)) for arm in arms if arm.problems]
        tables["problems"] = TextTable("Lines that are no skill", ("L", "grammar", *kinds), lines, 2)
    return tables


def _arm(about: dict[str, Any], grammar: bool, rows: pd.DataFrame) -> Arm:
    problems: Counter[str] = Counter()
    for text in rows["problems"]:
        problems.update(json.loads(text))
    return Arm(
        about,
        grammar,
        len(rows),
        Share(int(rows["skills"].sum()), int(rows["lines"].sum())),
        Share(int(rows["as_ordered"].sum()), len(rows)),
        int(rows["cut"].sum()),
        dict(problems),
    )


def _names(arm: Arm) -> tuple[str, str]:
    return arm.about["name"], "with" if arm.grammar else "without"


def _shares(run: StoredRun, arms: list[Arm]) -> TextTable:
    """Lay out the shares, a line a format and way to ask."""
    settings = run.manifest["configuration"]
    lines: list[tuple[str, ...]] = [
        (*_names(arm), f"{arm.valid.count} of {arm.valid.of}", str(arm.valid), str(arm.as_ordered)) for arm in arms
    ]
    header = ("L", "grammar", "valid lines", "share (%)", f"answers of exactly {settings['n_skills']} skills (%)")
    title = f"Valid skills: {arms[0].about['skill_set']}, N = {settings['n_skills']}, {settings['answers']} answers"
    rules = frozenset(
        place for place, arm in enumerate(arms) if place and arms[place - 1].about["name"] != arm.about["name"]
    )
    return TextTable(title, header, lines, 2, rules, tuple(_notes(run, arms)))


def _formats(run: StoredRun) -> TextTable:
    """Return the requested format, and its cost with this model."""
    lines: list[tuple[str, ...]] = [
        (
            about["name"],
            about["wording"],
            about["example"].replace("\n", ""),
            "{least} / {mean:.3g} / {most}".format(**about["tokens_per_skill"]),
        )
        for about in run.manifest["formats"]
    ]
    return TextTable("Formats", ("L", "wording", "example", "tokens a skill: least / mean / most"), lines, 3)


def _notes(run: StoredRun, arms: list[Arm]) -> Iterator[str]:
    """Return what a reader must know besides the numbers."""
    yield "[]: 95 % Clopper-Pearson; for lines as if they were independent, which those of one answer are not."
    yield f"The first {run.manifest['configuration']['n_skills']} lines of an answer count. One prompt, no picture."
    if run.manifest["model"]["dummy"]:
        chance = "DUMMY WEIGHTS: without a grammar this is what chance gives; it says nothing about any real model."
        yield Note(chance, DUMMY)
    free = [arm for arm in arms if not arm.grammar]
    if cut := sum(arm.cut for arm in free):
        answers = sum(arm.answers for arm in free)
        yield f"{cut} of {answers} answers without grammar were cut off at their most tokens (--max-tokens)."


def show_validity(run: StoredRun) -> None:
    """Write and print what a run comes to."""
    output.show(run, validity_tables(run), {}, {})
