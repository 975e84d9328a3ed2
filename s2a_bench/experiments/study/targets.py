"""The study that stream-to-act has to pass: 192 settings, calibrated on 400 plans each, judged on others.

R {34.2, 4.8, .58} tokens/s (c = .05, .5, 3 s) x L {6, 4, 2, 1} x N {4, 8, 16, 32} x T_nom {.5, 1, 2, 4} s. In each
setting the prior and lambda come from the calibration plans alone; the other plans are looked at once. What is wanted
of the result, and whether it was reached, is `view.targets`' to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Final

from s2a_bench.experiments.study.config import Cell, StudyConfig
from s2a_bench.experiments.study.rows import StudyRow
from s2a_bench.experiments.study.to_rows import study_row
from s2a_bench.experiments.study.worlds import World, calibrated
from s2a_bench.policy.stream_to_act import MeanStart, QuantileStart
from s2a_bench.policy.wait_then_act import WaitThenAct

PLANS: Final = 5000
"""Plans a setting that are judged."""

WORLDS: Final = tuple(
    World(rate, prompt_s, tokens, skills, t_nom_s)
    for (rate, prompt_s), tokens, skills, t_nom_s in product(
        ((34.2, 0.05), (4.8, 0.5), (0.58, 3.0)), (6, 4, 2, 1), (4, 8, 16, 32), (0.5, 1.0, 2.0, 4.0)
    )
)


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List the settings."""
    return [partial(setting, config, world) for world in WORLDS]


def setting(config: StudyConfig, world: World) -> list[StudyRow]:
    """Calibrate in one setting and judge stream-to-act there, beside the simpler rules."""
    policy, plans = calibrated(config, world, PLANS)
    policies = (policy, QuantileStart(policy.prior), MeanStart(policy.prior), WaitThenAct())
    return [study_row(config.name, world, each, plans, calibration_plans=config.calibration_plans) for each in policies]
