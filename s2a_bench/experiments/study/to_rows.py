"""One cell's result as a row: what share of the plans stalls, and what not stalling costs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.experiments.study.rows import StudyRow
from s2a_bench.experiments.study.worlds import World
from s2a_bench.policy import Plans, Policy
from s2a_bench.policy.conformal import TOLERANCE_S, upper_bound
from s2a_bench.policy.metrics import Metrics, measure

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


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
    found = measure(plans, policy.schedule(plans), tolerance_s=TOLERANCE_S)
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
    found: Metrics,
    *,
    caution: float | None = None,
    calibration_plans: int = 0,
    condition: str = "",
    block: int = 0,
) -> StudyRow:
    """Describe timelines that have been measured; a lambda that is infinite is null."""
    from s2a_bench.boards.gaps import FAMILIES

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
        p_too_early=float(np.mean(found.too_early_s > TOLERANCE_S)),
    )


def _mean(values: Floats) -> float:
    return float(np.nanmean(values))
