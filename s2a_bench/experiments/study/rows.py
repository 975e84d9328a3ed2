"""The rows of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from s2a_bench.store.bounds import Count, Fraction, Many, NonNegative, Positive, about
from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One cell of a study: plans drawn from one world, decided by one policy.

    ``family`` names the gaps' distribution, ``condition`` what else was varied and ``block`` which stretch of a
    sequence of plans it is. Regrets are means over the plans, as `policy.metrics` defines them; ``caution`` is null
    where the policy waits for whole plans or knows no lambda; ``p_any_stall_high`` is the upper end of the two-sided
    95 % Clopper-Pearson interval. Nothing in a study is measured: the plans are drawn. Fields with a default are null
    in folders from before they were there.
    """

    study: Annotated[str, {"enum": ["targets", "frontier", "drift", "shift", "split", "misfit"]}]
    policy: str
    tokens_per_s: Positive
    prompt_s: Annotated[NonNegative, about("c: from the request to the start of decoding.")]
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    n_skills: Many
    t_nom_s: Positive
    rho: Annotated[Positive, about("L / R / T_nom.")]
    family: Annotated[str, about("Distribution of the gaps.")]
    condition: Annotated[str, about("What else was varied; calibrated: lambda as calibration chose it.")]
    block: Annotated[Count, about("Which stretch of a sequence of plans.")]
    caution: Annotated[
        NonNegative | None, about("lambda; absent where whole plans are waited for, or the policy knows none.")
    ]
    calibration_plans: Count
    plans: Many
    stalled: Count
    p_any_stall: Fraction
    p_any_stall_high: Annotated[Fraction, about("Upper end of the two-sided 95 % Clopper-Pearson interval.")]
    start_s: NonNegative
    end_s: NonNegative
    start_regret: Annotated[NonNegative, about("Mean of max(0, s_1 - S0) / S0.")]
    signed_start_regret: float
    start_regret_of_wait: Annotated[NonNegative | None, about("Over t_N - S0; absent where t_N = S0 in every plan.")]
    end_regret: Annotated[float, about("Mean of (e_N - E) / E with E = S0 + P_N.")]
    end_regret_of_wait: float | None
    start_regret_elastic: Annotated[NonNegative | None, about("Mean of max(0, s_1 - S_lo) / S_lo.")] = None
    end_regret_elastic: Annotated[float | None, about("Mean of (e_N - E_lo) / E_lo.")] = None
    speed_distortion: Annotated[NonNegative | None, about("Mean of durations over nominal ones.")] = None
    stalls: Annotated[NonNegative | None, about("Mean number of stalls a plan.")] = None
    p_too_early: Annotated[
        Fraction | None, about("Share of the plans that start before S_lo: no stretching can keep them from stalling.")
    ] = None
    seed: Annotated[Count | None, about("Of the study it is from, where several were run.")] = None


STUDY_CELLS: Final[Table[StudyRow]] = Table("studies", StudyRow)
"""One row a cell of a study."""
