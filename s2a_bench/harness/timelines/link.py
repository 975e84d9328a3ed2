"""Requests for answer plans: their prompts, the run's session with a model, and its warm-up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, product
from typing import Final

import numpy as np

from s2a_bench.act.events import PlanFeed
from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import RunPlan, resolve
from s2a_bench.harness.rounds import RunningLaunch
from s2a_bench.harness.servers import on_files
from s2a_bench.harness.session import Measured, Place, RequestContext
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.config import PlanRequests
from s2a_bench.harness.timelines.policies import prior_of
from s2a_bench.harness.warnings import change_warnings
from s2a_bench.machine.tuning import limit_threads
from s2a_bench.plan import Format, SkillSet, Tokenize, choose_format, grammar, paper_format, prompt
from s2a_bench.policy import Floats, PlanShape, Timing
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins
from s2a_bench.stats.batches import Rows
from s2a_bench.store.manifest import RunWarning

TOKENS_A_SKILL: Final = 16
"""Tokens a skill that a model of unknown tokenizer may need for the paper's format."""
LATE = 1.05
"""An answer slower than the pace by this factor was not held back."""


@dataclass(frozen=True, slots=True)
class PlanPrompt:
    """The request for the plans of one setting."""

    skills: SkillSet
    format: Format
    tokens_per_skill: int
    n_skills: int
    prompt: str
    grammar: str
    max_tokens: int

    @property
    def shape(self) -> PlanShape:
        """Return the facts about the plan before its first token: all calls are equally likely."""
        times = [call.skill.durations for call in self.skills.calls]
        nominal_s = np.array([time.nominal_s for time in times])
        mean_s = float(nominal_s.mean())
        timing = Timing(
            mean_s, float(np.mean([time.least_s for time in times])), float(np.mean([time.most_s for time in times]))
        )
        return PlanShape(self.n_skills, self.tokens_per_skill, timing, float(nominal_s.std()) / mean_s)


@dataclass(frozen=True, slots=True)
class PromptPlan:
    """The answer plans that a run requests: a prompt for each length, number of skills and skill set."""

    skill_sets: Sequence[SkillSet]
    """One skill set, a copy for each duration of its skills."""
    tokens_per_skill: Sequence[int]
    n_skills: Sequence[int]
    task: str = ""
    grammar: bool = True
    """Whether a grammar holds the answers to their form."""


def plan_requests(requests: PlanRequests, plan: PromptPlan, progress: Progress) -> tuple[RunPlan, list[PlanPrompt]]:
    """Return the run plan of long enough requests, with the model's files, and the prompts; raises S2AError."""
    limit_threads()
    run = resolve(requests, progress.say)
    tokenize: Tokenize | None = None
    if run.finds_model:
        from s2a_bench.inference.tokenizer import Tokenizer

        run = replace(run, engine=on_files(run.engine, progress), finds_model=False)
        tokenize = Tokenizer(run.engine.model)
    prompts = write_prompts(plan, tokenize, exact=tokenize is not None or run.engine.kind.plays is not None)
    longest = max(each.max_tokens for each in prompts)
    request = replace(run.request, grammar=prompts[0].grammar, max_pieces=longest)
    return replace(run, request=request), prompts


def write_prompts(plan: PromptPlan, tokenize: Tokenize | None, *, exact: bool) -> list[PlanPrompt]:
    """Write the prompts for a tokenizer, in the paper's format if it is unknown; raises UsageError if no format fits.

    ``exact``: every skill has the planned number of tokens.
    """
    prompts = []
    for tokens, n_skills, skills in product(plan.tokens_per_skill, plan.n_skills, plan.skill_sets):
        format_ = paper_format(skills) if tokenize is None else choose_format(skills, tokens, tokenize, n_skills)
        rules = grammar(format_, n_skills, tokenize) if plan.grammar else ""
        most = n_skills * (tokens if exact else TOKENS_A_SKILL)
        text = prompt(format_, n_skills, plan.task)
        prompts.append(PlanPrompt(skills, format_, tokens, n_skills, text, rules, most))
    return prompts


@dataclass
class ModelRequests:
    """The requests of one run to one model."""

    launch: RunningLaunch
    first: PlanPrompt
    """The prompt of the warm-up requests."""
    robot: str
    """The robot's entry in the manifest."""
    blocks: Iterator[int] = field(default_factory=count)
    learned_ms: list[Floats] = field(default_factory=list)
    """Gaps between tokens of each warm-up, from which policies learn."""
    seen_ms: list[Floats] = field(default_factory=list)
    """The observed delays of each plan."""

    def __post_init__(self) -> None:
        (self.session,) = self.launch.sessions
        self.cell, self.writer = self.session.cell, self.launch.writer
        self.pace = self.rate = self.launch.plan.engine.pace
        """Tokens/s: set, or of the first answer."""
        self._write_origin()
        self.writer.update(
            live={
                "transport": self.cell.name,
                **({"paced_tokens_per_s": self.pace} if self.pace else {}),
                "grammar": bool(self.first.grammar),
                "skills": self.first.skills.name,
                "robot": self.robot,
            },
        )

    def _write_origin(self) -> None:
        self.origin = self.session.origin
        dummy = {"dummy": True, "real": False}.get(self.origin.weights)
        live = {"engine": self.origin.engine, "emulated": self.origin.emulated}
        self.writer.update(
            provenance=Origins(self.origin).to_manifest(), live=live if dummy is None else {**live, "dummy": dummy}
        )

    def warm_up(self) -> GapPrior | None:
        """Make the warm-up requests and return the prior that policies learn from them."""
        warmups, progress = self.launch.plan.blocks.warmup, self.launch.progress
        arrivals_ns = []
        for _ in range(warmups):
            progress.stage("warming up")
            measured = self.request(self.first, 0, None)
            arrivals_ns.append([token.client_ns for token in measured.tokens])
            progress.advance()
        self.learned_ms += [np.diff(times) / 1e6 for times in arrivals_ns]
        prior = prior_of(arrivals_ns, self.rate)
        if prior is not None:
            self.rate = self.rate or 1 / prior.mean_s
            values = {"mean_s": prior.mean_s, "plan_cv": prior.plan_cv, "token_cv": prior.token_cv}
            self.writer.update(prior={**values, "warmups": warmups})
        return prior

    def request(self, of: PlanPrompt, plan: int, feed: PlanFeed | None) -> Measured:
        """Make one request and write its rows; raises an error that ends the run."""
        run = self.session.request
        request = replace(run, prompt=of.prompt, grammar=of.grammar, max_pieces=of.max_tokens, seed=run.seed + plan)
        place = Place(next(self.blocks), 0, warmup=feed is None)
        measured = self.session.measure(place, RequestContext(plan=feed, request=request))
        if self.session.origin != self.origin:
            self._write_origin()
        try:
            self.launch.keep(self.session, measured)
        except UsageError as error:
            if "grammar" not in str(error):
                raise
            raise UsageError(f"{error} (`no_grammar` leaves it out)") from error
        return measured

    def setting(self, of: PlanPrompt) -> PlanSetting:
        return PlanSetting(
            board="",
            title=f"live {self.cell.name}",
            tokens_per_s=float(f"{self.rate or 0.0:.4g}"),
            prompt_s=None,
            tokens_per_skill=of.tokens_per_skill,
            n_skills=of.n_skills,
            t_nom_s=of.shape.expected.nominal_s,
            mode="live",
            emulated=self.origin.emulated,
        )

    def learn_rate(self, token_ns: Sequence[int]) -> None:
        """Learn the rate from an answer unless it is set, and warn if the model was slower."""
        if len(token_ns) < 2:  # noqa: PLR2004 - no gap
            return
        rate = (len(token_ns) - 1) / (token_ns[-1] - token_ns[0]) * 1e9
        self.rate = self.rate or rate
        self.seen_ms.append(np.diff(token_ns) / 1e6)
        if self.pace and rate * LATE < self.pace:
            what = f"the model sent {rate:.3g} tokens/s, not the {self.pace:g} of --pace: it is slower"
            advice = "stop other programs, try --threads 1, or a lower --pace"
            self.launch.warnings.append(RunWarning("pace-missed", what, advice))

    def compare(self) -> None:
        """Warn if the plans' tokens came at other gaps than those of the warm-ups."""
        advice = "policies learned from the warm-ups: take more, --warmup, or follow the change, --track"
        learned, seen = Rows.of(self.learned_ms), Rows.of(self.seen_ms)
        self.launch.warnings.extend(change_warnings(self.cell.name, learned, seen, "ms a token", advice))
