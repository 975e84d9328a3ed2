"""What a timeline run compares: policies on boards, granularities, lengths and durations; and what it refuses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Final

from s2a_bench.boards.search import load_profile
from s2a_bench.errors import UsageError
from s2a_bench.experiments.timeline.plans import NO_JITTER, Board, board_of_profile, board_of_rate
from s2a_bench.experiments.timeline.to_rows import Setting
from s2a_bench.harness.ranges import LEAST_T_NOM_S, require
from s2a_bench.policy import PlanShape, Policy, Timing, policies
from s2a_bench.policy.conformal import EPSILON
from s2a_bench.policy.conformal import PLANS as CALIBRATION_PLANS
from s2a_bench.policy.conformal import check as check_calibration

PLANS: Final = 1000
"""Plans a cell where something is random; one where nothing is."""
MOST_SKILLS: Final = 2_000_000
"""Skills that one run computes: beyond that, studies are the tool."""
MOST_TOKENS: Final = 20_000_000
"""Tokens of a cell: they are held in memory at once."""
MOST_CV: Final = 3**-0.5
"""Uniform durations of a larger spread could be negative."""


@dataclass(frozen=True)
class TimelineConfig:
    """What is compared with what."""

    policies: tuple[str, ...] = ("naive", "wait-then-act", "stream-to-act")
    profiles: tuple[str, ...] = ("rtx-4080", "jetson-agx-orin", "jetson-orin-nano")
    rates: tuple[float, ...] = ()
    """Boards of which only the rate is known, in tokens/s."""
    prompt_s: float | None = None
    """c for every board; None: the profiles' own, and 0 for rates."""
    tokens_per_skill: tuple[int, ...] = (6, 4, 2, 1)
    n_skills: tuple[int, ...] = (8,)
    t_nom_s: tuple[float, ...] = (1.0,)
    t_min: float = 0.8
    """T_min over T_nom."""
    t_max: float = 1.5
    t_nom_cv: float = 0.0
    """How much T_nom differs from skill to skill, known only when a skill has been parsed."""
    jitter: str = NO_JITTER
    plans: int | None = None
    calibration_plans: int = CALIBRATION_PLANS
    epsilon: float = EPSILON
    gap_bound: float | None = None
    """What s2a-robust is told: the longest gap between skills over L / R; None: there is no bound."""
    calibrate: Path | None = None
    """A run folder whose answers prior and lambda are learned from, instead of drawn plans."""
    seed: int = 0

    @cached_property
    def boards(self) -> list[Board]:
        """Find the boards; raises UsageError for a profile, rate or jitter that there is not."""
        require("--rate", self.rates, 0, above=True)
        found = [board_of_profile(load_profile(name), self.jitter, self.prompt_s) for name in self.profiles]
        return found + [board_of_rate(rate, self.jitter, self.prompt_s) for rate in self.rates]

    @cached_property
    def chosen(self) -> dict[str, Policy]:
        """Build the policies, by their canonical names; raises UsageError."""
        return policies(self.policies)

    @property
    def random(self) -> bool:
        """Tell whether one plan differs from the next."""
        return self.t_nom_cv > 0 or not all(board.even for board in self.boards)

    @property
    def plans_a_cell(self) -> int:
        """Return how many plans each cell has."""
        return self.plans if self.plans is not None else PLANS if self.random else 1

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError naming the flag."""
        _ = self.chosen
        for flag, values in (("--policy", self.policies), ("--profile or --rate", (*self.profiles, *self.rates))):
            if not values:
                raise UsageError(f"{flag}: name at least one")
        require("--tokens-per-skill", self.tokens_per_skill, 1)
        require("--n-skills", self.n_skills, 1)
        require("--t-nom", self.t_nom_s, LEAST_T_NOM_S)
        require("--t-min (a factor of T_nom)", [self.t_min], 0, 1, above=True)
        require("--t-max (a factor of T_nom)", [self.t_max], 1)
        require("--t-nom-cv", [self.t_nom_cv], 0, MOST_CV)
        require("--prompt-time", [] if self.prompt_s is None else [self.prompt_s], 0)
        require("--gap-bound", [] if self.gap_bound is None else [self.gap_bound], 0, above=True)
        require("--plans", [self.plans_a_cell], 1)
        check_calibration(self.calibration_plans, self.epsilon)
        require("--seed", [self.seed], 0)
        if self.calibrate is not None and len(self.boards) != 1:
            raise UsageError("--calibrate: the recorded machine is one board; name it with one --profile or --rate")
        if self.plans_a_cell > 1 and not self.random:
            raise UsageError("--plans: without --jitter or --t-nom-cv all plans are the same; leave it out")
        skills = sum(setting.n_skills for _, setting in settings(self)) * len(self.chosen) * self.plans_a_cell
        if skills > MOST_SKILLS:
            raise UsageError(f"--plans: {skills} skills are more than the {MOST_SKILLS} of one run; ask for fewer")
        tokens = max(self.n_skills) * max(self.tokens_per_skill)
        if (drawn := tokens * max(self.plans_a_cell, self.calibration_plans)) > MOST_TOKENS:
            raise UsageError(
                f"--n-skills, --tokens-per-skill: {tokens} tokens a plan, {drawn} a cell: {MOST_TOKENS} is the most"
            )

    def shape(self, setting: Setting) -> PlanShape:
        """Return what is known of a plan before its first token."""
        t_nom_s = setting.t_nom_s
        timing = Timing(t_nom_s, self.t_min * t_nom_s, self.t_max * t_nom_s)
        return PlanShape(setting.n_skills, setting.tokens_per_skill, timing, self.t_nom_cv)


def settings(config: TimelineConfig) -> Iterator[tuple[Board, Setting]]:
    """List what is compared, board by board."""
    for n_skills, t_nom_s, board, tokens in product(
        config.n_skills, config.t_nom_s, config.boards, config.tokens_per_skill
    ):
        yield board, Setting(board.name, board.title, board.tokens_per_s, board.prompt_s, tokens, n_skills, t_nom_s)
