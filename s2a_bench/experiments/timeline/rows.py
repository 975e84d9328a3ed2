"""The rows of a timeline run; their annotations are the metrics: columns, JSON, CSV, tables and comparison follow.

A new metric is a column, and its values by its name in `policy.metrics`, or that of a plan in
`build_rows.timeline_rows`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final

from s2a_bench.bounds import Many, NonNegative, Positive, about
from s2a_bench.experiments.cells import ANY, HIDDEN, SHARE, TO_ONE, JsonKey, Metric, mean, metrics_of, share
from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True, kw_only=True)
class TimelineRow:
    """One plan under one policy. Motion is null for plans whose skills are not kept.

    ``board`` is a profile's name, empty for a given rate. All times count from ``requested_ns``, 0 in virtual time.
    """

    cell: str
    policy: str
    board: Annotated[str, JsonKey("profile"), about("Null if a rate was given, or a model answered.")]
    title: Annotated[str, HIDDEN]
    mode: Annotated[str, about("virtual: computed; else the clock that it was executed on.")]
    emulated: Annotated[bool, about("True where no model answered.")]
    tokens_per_s: Annotated[Positive, JsonKey("rate_tokens_per_s")]
    prompt_s: Annotated[
        NonNegative | None, about("c: from the request to the start of decoding; absent if a model answered.")
    ]
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    n_skills: Many
    t_nom_s: Positive
    plan: Annotated[int, HIDDEN]
    request_id: Annotated[str, HIDDEN]
    requested_ns: Annotated[int, HIDDEN]
    caution: Annotated[NonNegative | None, about("lambda; absent if the policy has none, or waits for the whole plan.")]
    start_ns: Annotated[int, Metric("start", "Time to first action, s_1.")]
    end_ns: Annotated[int, Metric("end", "Completion, e_N.")]
    safe_start_ns: Annotated[int, Metric(about="S0.")]
    last_arrival_ns: Annotated[int, Metric(about="t_N.")]
    safe_end_ns: Annotated[int, Metric(about="S0 + P_N.")]
    least_end_ns: Annotated[int, Metric(about="E_lo.")]
    stalls: Annotated[int, mean("stalls", "Stalls longer than 20 ms a plan.")]
    any_stall: Annotated[bool, mean("P(stall)", "Share of the plans that stall at all.", bounds=TO_ONE)]
    stall_ns: Annotated[int, mean("stalled", "All stalls of a plan together.")]
    longest_stall_ns: Annotated[int, mean("longest")]
    stall_ratio: Annotated[float, share("stall ratio", "Stalled share of the time from first action to completion.")]
    start_regret: Annotated[float | None, mean("late start", "max(0, s_1 - S0) / S0.", kind=SHARE)] = None
    start_regret_elastic: Annotated[
        float | None,
        mean("over S_lo", "max(0, s_1 - S_lo) / S_lo, over the least start that T_max allows.", kind=SHARE),
    ] = None
    signed_start_regret: Annotated[float | None, mean(about="(s_1 - S0) / S0.", bounds=ANY)] = None
    start_regret_of_wait: Annotated[
        float | None, mean("of wait", "max(0, s_1 - S0) / (t_N - S0); absent where t_N = S0.", kind=SHARE)
    ] = None
    end_regret: Annotated[float, mean("late end", "(e_N - E) / E with E = S0 + P_N.", kind=SHARE, bounds=ANY)]
    end_regret_of_wait: Annotated[
        float | None, mean(about="(e_N - E) / (t_N - S0); absent where t_N = S0.", bounds=ANY)
    ] = None
    end_regret_elastic: Annotated[
        float, mean("over E_lo", "(e_N - E_lo) / E_lo, over the least end that T_min allows.", kind=SHARE, bounds=ANY)
    ]
    mean_queue_wait_ns: Annotated[int, mean("queued", "s_i - t_i.")]
    longest_queue_wait_ns: Annotated[int, mean("longest")]
    mean_action_age_ns: Annotated[int, Metric("age", "s_i - the time of the picture.")]
    oldest_action_ns: Annotated[int, Metric("oldest")]
    speed_distortion: Annotated[float, mean("distortion", "Durations over nominal ones.")]
    fluidity: Annotated[float, mean("fluidity", "Share of deadlines met (Etalon).", better="higher", bounds=TO_ONE)]
    rms_jerk: Annotated[
        float | None, mean("RMS jerk", "Of a model: 1 / s^2 at unit speed; mean over the plans whose skills are kept.")
    ] = None
    peak_jerk: Annotated[float | None, mean("peak jerk")] = None
    sparc: Annotated[
        float | None, mean("SPARC", "Spectral arc length: closer to 0 is smoother.", better="higher", bounds=(None, 0))
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimelineCell(TimelineRow):
    """A policy in one setting: means over its plans."""

    means: ClassVar[bool] = True
    plans: Annotated[Many, about("Number of plans that the means are over.")]


METRICS: Final = metrics_of(TimelineRow)
TIMELINES: Final[Table[TimelineRow]] = Table("timelines", TimelineRow)
