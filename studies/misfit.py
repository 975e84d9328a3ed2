"""What wrong beliefs cost: plans of another length, skills of another granularity, a machine of another speed.

Prior and lambda are calibrated with the right beliefs; then one of them is replaced by a wrong one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, study_row
from studies.worlds import World, calibrated

PLANS: Final = 4000
SKILLS: Final = (-4, -2, -1, 0, 1, 2, 4)
"""Skills believed, beyond those that come."""
TOKENS: Final = (0.5, 0.75, 1.0, 1.25, 1.5)
"""Tokens a skill believed, over the true number."""
GAPS: Final = (0.5, 0.8, 1.0, 1.25, 2.0)
"""The prior's mean gap, over the true one."""

WORLDS: Final = (World(4.8, 0.5, 4, 8, 1.0), World(4.8, 0.5, 6, 8, 1.0), World(0.58, 3.0, 6, 8, 1.0))


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List the worlds."""
    return [partial(cell, config, world) for world in WORLDS]


def cell(config: StudyConfig, world: World) -> list[StudyRow]:
    """Try each wrong belief on the same plans."""
    policy, plans = calibrated(config, world, PLANS)
    shape, prior = world.shape, policy.prior
    tried = [
        *((f"N {more:+d}", policy, replace(shape, n_skills=shape.n_skills + more)) for more in SKILLS),
        *(
            (f"L x {times:g}", policy, replace(shape, tokens_per_skill=shape.tokens_per_skill * times))
            for times in TOKENS
        ),
        *(
            (f"gap x {times:g}", replace(policy, prior=replace(prior, mean_s=prior.mean_s * times)), shape)
            for times in GAPS
        ),
    ]
    return [
        study_row(
            config.name,
            world,
            believer,
            replace(plans, shape=believed),
            calibration_plans=config.calibration_plans,
            condition=condition,
        )
        for condition, believer, believed in tried
    ]
