"""What ``--json`` and its schema hold of a CCRB run: a policy at the operating point, and what its studies counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from s2a_bench.experiments.ccrb.rows import FollowerRow, RolloutRow, SensitivityRow
from s2a_bench.plan.skillset import GAPS
from s2a_bench.store.bounds import Count, Fraction, Many, NonNegative, Positive, about
from s2a_bench.writers.as_json import cell_of_row

ORDERINGS: Final = {
    "paper": "the paper's ordering",
    "wait_worse": "wait worse than stream",
    "wait_better": "wait better",
    "naive_worse": "naive worse than stream",
    "naive_better": "naive better",
    "naive_rear_worse": "naive worse behind",
    "naive_rear_better": "naive better behind",
}

_DEADLINE = "S_front: who brakes as planned from then on keeps 2 m to the lead; negative: too late from the beginning."

CcrbCell = cell_of_row(
    "CcrbCell",
    "A policy at the operating point.",
    RolloutRow,
    without=("study", "draw", "board", "title", "tokens_per_s", "start_ns", "end_ns", "stall_ns", "deadline_ns"),
    own={
        "profile": str | None,
        "rate_tokens_per_s": Positive,
        "start_s": NonNegative,
        "end_s": NonNegative,
        "stall_s": NonNegative,
        "deadline_s": Annotated[float, about(_DEADLINE)],
    },
)

CcrbFollower = cell_of_row(
    "CcrbFollower",
    "Counts of points of the plane under one policy, with one follower and lead; without a seed: the operating point.",
    FollowerRow,
    without=("cell",),
    own={},
)
CcrbSensitivity = cell_of_row(
    "CcrbSensitivity",
    "At how many of the points that a seed drew the paper's ordering holds, one number changed.",
    SensitivityRow,
    without=("cell",),
    own={},
)


@dataclass(frozen=True)
class OrderingShare:
    """In how many scenarios an ordering holds."""

    k: Count
    value: Fraction
    ci95: Annotated[tuple[float, float] | None, about("Clopper-Pearson; random scenarios only.")] = None


@dataclass(frozen=True)
class CcrbStudy:
    """The shares of one study under one gap behaviour.

    Orderings: the paper's; a policy's impact is more than 0.5 m/s faster (worse) or slower (better) than
    stream-to-act's, of any kind or from behind.
    """

    study: Literal["phase", "random"]
    gap_behaviour: Annotated[str, {"enum": list(GAPS)}]
    scenarios: Many
    orderings: Annotated[
        dict[str, OrderingShare], {"required": list(ORDERINGS), "propertyNames": {"enum": list(ORDERINGS)}}
    ]
    follower_survives: Annotated[
        OrderingShare | None,
        about("Where the car behind stops behind an ego whose tokens come at once; elsewhere rear says nothing."),
    ] = None
    paper_rates_tokens_per_s: Annotated[
        tuple[float, float] | None,
        about("Least and greatest R at which the paper's ordering holds; absent where it does nowhere."),
    ] = None
