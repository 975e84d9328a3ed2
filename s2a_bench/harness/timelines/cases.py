"""The parts of a run of plans: its cases, each with a board and a shape, and what policies learn before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

from s2a_bench.boards.tokens import Board
from s2a_bench.policy import Floats, PlanShape
from s2a_bench.policy.conformal import EPSILON, PLANS, Guarantee
from s2a_bench.stats.seeds import Verbatim
from s2a_bench.types import Timing

MOST_CV: Final = 3**-0.5
"""Uniform durations of a larger spread could be negative."""


@dataclass(frozen=True, slots=True)
class PlanSetting:
    """The parameters of plans, without the policy."""

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
    emulated: bool = True

    @property
    def name(self) -> str:
        board = self.board or f"{self.tokens_per_s:g}tps"
        return f"{board}/L{self.tokens_per_skill}/N{self.n_skills}/T{self.t_nom_s:g}"

    @property
    def key(self) -> Verbatim:
        """Return what its draws follow from: another field, or another name of one, is another draw."""
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
        """Return the case of a board and plans of a whole number of tokens a skill."""
        return cls(
            PlanSetting(
                board=board.name,
                title=board.title,
                tokens_per_s=board.tokens_per_s,
                prompt_s=board.prompt_s,
                tokens_per_skill=int(shape.tokens_per_skill),
                n_skills=shape.n_skills,
                t_nom_s=shape.expected.nominal_s,
                mode=mode,
            ),
            board,
            shape,
        )

    @property
    def tokens(self) -> int:
        """Return the number of tokens of a plan."""
        return self.setting.n_skills * self.setting.tokens_per_skill


@dataclass(frozen=True, slots=True)
class LearningPlan:
    """What policies learn from before the plans of a case: drawn plans of the same kind, or recorded answers."""

    seed: int
    random: bool = False
    """Whether plans of a case differ, and a policy learns from them."""
    calibration_plans: int = PLANS
    epsilon: float = EPSILON
    guarantee: Guarantee = "high-confidence"
    answers: Sequence[Floats] = ()
    """The times of the tokens of recorded answers, in s from the request."""


def stretched(t_nom_s: float, least: float, most: float) -> Timing:
    """Return the durations of a skill, the least and the longest as factors of T_nom."""
    return Timing(t_nom_s, least * t_nom_s, most * t_nom_s)
