"""The rows of a study: what share of a cell's plans stalls, and what not stalling costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.boards.gaps import FAMILIES
from s2a_bench.policy import Plans, Policy
from s2a_bench.policy.conformal import ANY_STALL_S, upper_bound
from s2a_bench.policy.metrics import PlanMetrics, measure
from s2a_bench.store.schema import Table
from studies.worlds import World

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One cell of a study: plans drawn from one world, decided by one policy.

    ``family`` names the gaps' distribution, ``condition`` what else was varied and ``block`` which stretch of a
    sequence of plans it is. Regrets are means over the plans, as `policy.metrics` defines them; ``caution`` is null
    where the policy waits for whole plans or knows no lambda; ``p_any_stall_high`` is the upper end of the two-sided
    95 % Clopper-Pearson interval; ``p_too_early`` is the share of the plans that start before S_lo. Nothing in a study
    is measured: the plans are drawn.
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
    start_regret_of_wait: float | None
    end_regret: float
    end_regret_of_wait: float | None
    start_regret_elastic: float | None = None
    end_regret_elastic: float | None = None
    speed_distortion: float | None = None
    stalls: float | None = None
    p_too_early: float | None = None
    seed: int = 0


STUDY_CELLS: Final[Table[StudyRow]] = Table("studies", StudyRow)
"""One row a cell of a study."""


def study_row(
    study: str,
    world: World,
    policy: Policy,
    plans: Plans,
    *,
    calibration_plans: int = 0,
    condition: str = "",
) -> StudyRow:
    """Let a policy decide the plans and describe the outcome."""
    found = measure(plans, policy.schedule(plans), tolerance_s=ANY_STALL_S)
    return row_of(
        study,
        world,
        policy.name,
        found,
        caution=getattr(policy, "caution", None),
        calibration_plans=calibration_plans,
        condition=condition,
    )


def row_of(
    study: str,
    world: World,
    policy: str,
    found: PlanMetrics,
    *,
    caution: float | None = None,
    calibration_plans: int = 0,
    condition: str = "",
    block: int = 0,
) -> StudyRow:
    """Describe timelines that have been measured; a lambda that is infinite is null."""
    plans = found.end_s.size
    stalled = int(np.count_nonzero(found.stalls))
    names = {kind: name for name, kind in FAMILIES.items()}
    return StudyRow(
        study=study,
        policy=policy,
        tokens_per_s=world.tokens_per_s,
        prompt_s=world.prompt_s,
        tokens_per_skill=world.tokens_per_skill,
        n_skills=world.n_skills,
        t_nom_s=world.t_nom_s,
        rho=world.rho,
        family="lognormal" if world.gaps is None else names[type(world.gaps)],  # type: ignore[index]
        condition=condition,
        block=block,
        caution=None if caution is None or math.isinf(caution) else caution,
        calibration_plans=calibration_plans,
        plans=plans,
        stalled=stalled,
        p_any_stall=stalled / plans,
        p_any_stall_high=upper_bound(stalled, plans, 0.975),
        start_s=_mean(found.first_action_s),
        end_s=_mean(found.end_s),
        start_regret=_mean(found.start_regret),
        signed_start_regret=_mean(found.signed_start_regret),
        start_regret_of_wait=_mean(found.start_regret_of_wait),
        end_regret=_mean(found.end_regret),
        end_regret_of_wait=_mean(found.end_regret_of_wait),
        start_regret_elastic=_mean(found.start_regret_elastic),
        end_regret_elastic=_mean(found.end_regret_elastic),
        speed_distortion=_mean(found.speed_distortion),
        stalls=float(found.stalls.mean()),
        p_too_early=float(np.mean(found.too_early_s > ANY_STALL_S)),
    )


def _mean(values: Floats) -> float:
    return float(np.nanmean(values))
