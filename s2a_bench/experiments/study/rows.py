"""The rows of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One cell of a study: plans drawn from one world, decided by one policy.

    ``family`` names the gaps' distribution, ``condition`` what else was varied and ``block`` which stretch of a
    sequence of plans it is. Regrets are means over the plans, as `policy.metrics` defines them; ``caution`` is null
    where the policy waits for whole plans or knows no lambda; ``p_any_stall_high`` is the upper end of the two-sided
    95 % Clopper-Pearson interval. Nothing in a study is measured: the plans are drawn.
    """

    study: str
    policy: str
    tokens_per_s: float
    prompt_s: float
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    rho: float
    family: str
    condition: str
    block: int
    caution: float | None
    calibration_plans: int
    plans: int
    stalled: int
    p_any_stall: float
    p_any_stall_high: float
    start_s: float
    end_s: float
    start_regret: float
    signed_start_regret: float
    start_regret_of_wait: float
    end_regret: float
    end_regret_of_wait: float


STUDY_CELLS: Final[Table[StudyRow]] = Table("studies", StudyRow)
"""One row a cell of a study."""
