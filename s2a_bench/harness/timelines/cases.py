"""The parts of a run of answer plans: its cases, each with a board and a shape, and what policies learn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

from s2a_bench.boards.tokens import Board
from s2a_bench.policy import Floats, PlanShape, Policy
from s2a_bench.policy.conformal import EPSILON, PLANS, Guarantee
from s2a_bench.stats.seeds import Verbatim

MOST_CV: Final = 3**-0.5
"""Uniform durations of a larger spread could be negative."""


@dataclass(frozen=True, slots=True)
class PlanSetting:
    """The parameters of answer plans, without the policy."""

    board: str
    """A profile's name; empty for a bare rate."""
    title: str
    tokens_per_s: float
    prompt_s: float | None
    """c; None for a model."""
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    mode: str = "virtual"
    """The run mode: virtual or live."""
    emulated: bool = True

    @property
    def name(self) -> str:
        board = self.board or f"{self.tokens_per_s:g}tps"
        return f"{board}/L{self.tokens_per_skill}/N{self.n_skills}/T{self.t_nom_s:g}"

    @property
    def key(self) -> Verbatim:
        """Return the fields that seed the draws; renaming one changes them."""
        values = ", ".join(f"{field.name}={getattr(self, field.name)!r}" for field in fields(self))
        return Verbatim(f"Setting({values})")  # a name in the seeds of all published runs

    def request_id(self, plan: int) -> str:
        return f"{self.name}/{plan}"


@dataclass(frozen=True, slots=True)
class PlanCase:
    """The plans of one setting on modelled tokens."""

    setting: PlanSetting
    board: Board
    shape: PlanShape

    @classmethod
    def of(cls, board: Board, shape: PlanShape, mode: str = "virtual") -> PlanCase:
        rate, tokens, t_nom_s = board.tokens_per_s, int(shape.tokens_per_skill), shape.expected.nominal_s
        setting = PlanSetting(board.name, board.title, rate, board.prompt_s, tokens, shape.n_skills, t_nom_s, mode)
        return cls(setting, board, shape)

    @property
    def tokens(self) -> int:
        return self.setting.n_skills * self.setting.tokens_per_skill


@dataclass(frozen=True, slots=True)
class LearningPlan:
    """The policies by name, and what they learn before and from the plans of a case."""

    policies: Mapping[str, Policy]
    seed: int
    epsilon: float = EPSILON
    track: bool = False
    """Whether policies whose lambda is not set follow it from plan to plan."""
    random: bool = False
    """Whether modelled plans of a case differ."""
    calibration_plans: int = PLANS
    guarantee: Guarantee = "high-confidence"
    answers: Sequence[Floats] = ()
    """Recorded answers to learn from instead of drawn plans: the tokens' times in s from the request."""
