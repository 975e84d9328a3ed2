"""Stretching buys an earlier start or a reserve: what each split of it costs, under the same promise about stalls.

stream-to-act starts near S0 and keeps all stretching as a reserve; stream-to-act-early spends it on the start. Every
rule is calibrated by itself, for both guarantees, in settings where stalls threaten (every fifth of `targets` with
rho > .8). Beside start and stalls stands what the early start is paid with: slow motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final, get_args

from s2a_bench.policy import policies
from s2a_bench.policy.conformal import Guarantee, choose, scores
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.stats.seeds import generator
from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, study_row
from studies.targets import WORLDS as SETTINGS
from studies.worlds import HARD, World

PLANS: Final = 400
EARLY: Final = "stream-to-act-early"
RULES: Final = (
    StreamToAct.name,
    f"{EARLY}?spend=0.5",
    EARLY,
    *(f"{EARLY}?within={within:g}" for within in (0.5, 1, 2)),
    f"{EARLY}?start_caution=0.7",
)
WORLDS: Final = tuple(world for world in SETTINGS if world.rho > HARD)[1::5]


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List the settings."""
    return [partial(cell, config, world) for world in WORLDS]


def cell(config: StudyConfig, world: World) -> list[StudyRow]:
    """Calibrate every rule in one setting, for both guarantees, and judge it on the same other plans."""
    rng = generator(config.seed, config.name, world.key)
    calibration = world.draw(rng, config.calibration_plans)
    plans = world.draw(rng, config.plans or PLANS)
    assert calibration.token_s is not None  # noqa: S101 - worlds draw tokens
    prior = GapPrior.fit(calibration.token_s)
    rows = []
    for name, chosen in policies(RULES).items():
        assert isinstance(chosen, StreamToAct)  # noqa: S101 - all are its variants
        rule = replace(chosen, prior=prior)
        score = scores(rule, calibration)
        for guarantee in get_args(Guarantee):
            policy = replace(rule, caution=choose(score, config.epsilon, guarantee).caution)
            row = study_row(
                config.name, world, policy, plans, calibration_plans=config.calibration_plans, condition=guarantee
            )
            rows.append(replace(row, policy=name))
    return rows
