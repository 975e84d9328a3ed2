"""What rare stalls cost: P(any stall) against regret, for families of gaps, as lambda goes from 0 to waiting.

The lambdas that calibration would choose are tried once more, under the conditions of `CALIBRATED`, one a guarantee:
where a robot would be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from s2a_bench.boards.gaps import Bursty, Gaps, Lognormal, Markov, Recorded
from s2a_bench.policy.conformal import GRID, Guarantee
from s2a_bench.policy.stream_to_act import StreamToAct
from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, study_row
from studies.worlds import TOKEN_CV, QuantileStart, World, calibrated

PLANS: Final = 4000
CALIBRATED: Final[dict[Guarantee, str]] = {"high-confidence": "calibrated", "expected": "calibrated, expected"}

WORLDS: Final = (
    World(4.8, 0.5, 4, 8, 1.0),
    World(4.8, 0.5, 6, 8, 1.0),
    World(0.58, 3.0, 1, 8, 2.0),
    World(0.58, 3.0, 6, 8, 1.0),
)


def families(mean_s: float, recording: Sequence[float] = ()) -> list[Gaps]:
    """List the families: even; 2 % of the tokens in pauses of 10 times the gap; packets of 4; a recording, if any."""
    listed: list[Gaps] = [
        Lognormal(mean_s, TOKEN_CV),
        Markov(mean_s, TOKEN_CV, pause_share=0.02, pause_ratio=10.0, pause_tokens=3.0),
        Bursty(mean_s, TOKEN_CV, burst_tokens=4, within=0.1),
    ]
    if recording:
        listed.append(Recorded(mean_s, tuple(recording)))
    return listed


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List worlds and families."""
    return [
        partial(cell, config, replace(world, gaps=gaps))
        for world in WORLDS
        for gaps in families(1 / world.tokens_per_s, config.recording)
    ]


def cell(config: StudyConfig, world: World) -> list[StudyRow]:
    """Try every lambda on the same plans, for the elastic rule and the one that never stretches."""
    policy, plans = calibrated(config, world, PLANS)
    cautions = (*GRID, math.inf)
    found = [
        study_row(config.name, world, kind(policy.prior, caution), plans, calibration_plans=config.calibration_plans)
        for kind in (StreamToAct, QuantileStart)
        for caution in cautions
    ]
    chosen = []
    for guarantee, condition in CALIBRATED.items():
        there, _ = calibrated(config.but(guarantee=guarantee), world, PLANS)
        chosen.append(replace(found[cautions.index(there.caution)], condition=condition))
    return [*found, *chosen]
