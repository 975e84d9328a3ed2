"""What a live timeline asks of the model: prompt, grammar and length of each setting; and what policies know of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.following import Following, follow_live
from s2a_bench.experiments.timeline.live.config import in_paper_format, settings_asked, skills_lasting
from s2a_bench.plan import Format, SkillSet, choose_format, grammar, paper_format, prompt
from s2a_bench.policy import PlanShape, Timing
from s2a_bench.policy.estimator import LEAST_CV, PLAN_CV, GapPrior
from s2a_bench.policy.stream_to_act import CAUTION, StreamToAct

if TYPE_CHECKING:
    from s2a_bench.policy import Floats

ROOM: Final = 16
"""Tokens a skill that a model of unknown tokenizer may need for the paper's format."""


@dataclass(frozen=True, slots=True)
class Ask:
    """One setting, ready to be asked for."""

    skills: SkillSet
    format: Format
    tokens_per_skill: int
    n_skills: int
    prompt: str
    grammar: str
    max_tokens: int

    @property
    def t_nom_s(self) -> float:
        """Return what a skill takes in the mean."""
        return self.shape.expected.nominal_s

    @property
    def shape(self) -> PlanShape:
        """Return what is known of the plan before its first token: every call is as likely as any other."""
        times = [call.skill.durations for call in self.skills.calls]
        nominal_s = np.array([time.nominal_s for time in times])
        mean_s = float(nominal_s.mean())
        timing = Timing(
            mean_s, float(np.mean([time.least_s for time in times])), float(np.mean([time.most_s for time in times]))
        )
        return PlanShape(self.n_skills, self.tokens_per_skill, timing, float(nominal_s.std()) / mean_s)


def asks_of(config: TimelineConfig, model: Path | None) -> list[Ask]:
    """Word every setting for the tokenizer of ``model``; raises UsageError where there is no such format."""
    tokenize = None
    if not in_paper_format(config):
        from s2a_bench.inference.tokenizer import Tokenizer

        tokenize = Tokenizer(model)
    found = []
    for tokens, n_skills, t_nom_s in settings_asked(config):
        skills = skills_lasting(config, t_nom_s)
        format_ = paper_format(skills) if tokenize is None else choose_format(skills, tokens, tokenize, n_skills)
        # Token ids mean something to our own server only, which has the same model files.
        pinned = None if config.url else tokenize
        counted = tokens if tokenize is not None or config.engine.name == "replay" else ROOM
        found.append(
            Ask(
                skills,
                format_,
                tokens,
                n_skills,
                prompt(format_, n_skills, config.task),
                grammar(format_, n_skills, pinned) if not config.no_grammar else "",
                n_skills * counted,
            )
        )
    return found


def prior_of(arrivals_ns: Sequence[Sequence[int]], rate: float | None) -> GapPrior | None:
    """Learn the gaps from warm-ups; with a set rate but no warm-up only their mean; None where nothing is known."""
    gaps_s = np.array([float(gap) for times in arrivals_ns for gap in np.diff(times)]) / 1e9
    if gaps_s.size > 1 and gaps_s.mean() > 0:
        mean_s = float(gaps_s.mean())
        return GapPrior(mean_s, PLAN_CV, max(_spread_s(gaps_s) / mean_s, LEAST_CV))
    return None if rate is None else GapPrior(1 / rate, PLAN_CV, 2 * PLAN_CV)


def _spread_s(gaps_s: Floats) -> float:
    """Return sigma of a gap: of single gaps or, where gaps come in bursts and that says more, from sums over blocks."""
    size = max(1, round(gaps_s.size**0.5))
    blocks = gaps_s[: gaps_s.size // size * size].reshape(-1, size).sum(axis=1)
    of_blocks = float(blocks.std(ddof=1)) / size**0.5 if blocks.size > 1 else 0.0
    return max(float(gaps_s.std(ddof=1)), of_blocks)


def prepare(config: TimelineConfig, shape: PlanShape, prior: GapPrior | None) -> Following:
    """Tell online policies the prior, and lambda where it was not given: nothing is calibrated here, but tracked."""
    made = {
        name: replace(policy, prior=prior or policy.prior) if isinstance(policy, StreamToAct) else policy
        for name, policy in config.chosen.items()
    }
    if config.tracks:
        return follow_live(made, shape, config.epsilon, config.seed, config.track_file)
    told = {
        name: replace(policy, caution=CAUTION) if isinstance(policy, StreamToAct) and policy.caution is None else policy
        for name, policy in made.items()
    }
    return Following(shape, told)
