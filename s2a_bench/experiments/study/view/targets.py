"""What is wanted of stream-to-act in the study of targets, and what it reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.study.worlds import HARD
from s2a_bench.policy.conformal import upper_bound

if TYPE_CHECKING:
    import pandas as pd

ONLINE: Final = "stream-to-act"
POOLED, WORST, START, END = 0.01, 0.02, 0.05, 0.06
"""What is wanted: P(any stall) of all plans and of every setting, mean start and end regret."""


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
