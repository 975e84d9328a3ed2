"""The study that stream-to-act has to pass: 192 settings, calibrated on 400 plans each, judged on others.

R {34.2, 4.8, .58} tokens/s (c = .05, .5, 3 s) x L {6, 4, 2, 1} x N {4, 8, 16, 32} x T_nom {.5, 1, 2, 4} s. In each
setting the prior and lambda come from the calibration plans alone; the other plans are looked at once. `targets_of`
says what is wanted of the result, and what was reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Final

from s2a_bench.policy.conformal import upper_bound
from s2a_bench.policy.nominal import WaitThenAct
from s2a_bench.policy.stream_to_act import MeanStart
from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, study_row
from studies.worlds import HARD, QuantileStart, World, calibrated

if TYPE_CHECKING:
    import pandas as pd

ONLINE: Final = "stream-to-act"
POOLED, WORST, START, END = 0.01, 0.02, 0.05, 0.06
"""What is wanted: P(any stall) of all plans and of every setting, mean start and end regret."""

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


@dataclass(frozen=True, slots=True)
class Target:
    """One thing that is wanted, and what was reached."""

    what: str
    value: float
    limit: float

    @property
    def met(self) -> bool:
        """Whether it was reached."""
        return self.value <= self.limit


def targets_of(rows: pd.DataFrame) -> list[Target]:
    """Judge the rows of stream-to-act, one a setting, by the limits that it has to keep."""
    rows = rows[rows["policy"] == ONLINE]
    hard = rows[rows["rho"] > HARD]
    stalled, plans = int(rows["stalled"].sum()), int(rows["plans"].sum())
    return [
        Target("P(any stall), pooled, upper end of 95 %", upper_bound(stalled, plans, 0.975), POOLED),
        Target("P(any stall), worst setting", float(rows["p_any_stall"].max()), WORST),
        Target("start regret, all settings", float(rows["start_regret"].mean()), START),
        Target("start regret, rho > .8", float(hard["start_regret"].mean()), START),
        Target("end regret, all settings", float(rows["end_regret"].mean()), END),
        Target("end regret, rho > .8", float(hard["end_regret"].mean()), END),
    ]
