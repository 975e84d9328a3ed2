"""The rows of a timeline run, and its metric table, from which columns, JSON, CSV, tables and comparison follow.

A new metric is a row of the table, and an array of one number a plan under its name in `build_rows.metrics_of`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from s2a_bench.experiments import COUNT, FLAG, SHARE, TIME, Better, Metric, by_name, columns
from s2a_bench.store.schema import Table, with_fields


@dataclass(frozen=True, slots=True)
class TimelineMetric(Metric):
    """A metric of plans, with values of 0 or more by default."""

    bounds: tuple[float | None, float | None] = (0, None)

    def stored(self, value: float) -> int | float | bool:
        if self.kind == TIME:
            return round(float(value) * 1e9)
        # Times are exact to a nanosecond: smaller shares are rounding errors; adding 0.0 turns -0.0 into 0.0.
        plain: int | float | bool = self.column_type(value)
        return round(plain, 9) + 0.0 if isinstance(plain, float) else plain


def _time(name: str, title: str = "", about: str = "", statistic: str = "median") -> TimelineMetric:
    return TimelineMetric(name, "s", title=title, statistic=statistic, kind=TIME, about=about)


def _mean(name: str, title: str = "", about: str = "", better: Better = "lower", **more: Any) -> TimelineMetric:
    return TimelineMetric(name, "", better, title, "mean", about=about, **more)


_UNBOUND: Final = (None, None)
_SHARE: Final = (0, 1)

METRICS: Final[Mapping[str, TimelineMetric]] = by_name(
    (
        _time("start_s", "start", "Time to first action, s_1."),
        _time("end_s", "end", "Completion, e_N."),
        _time("safe_start_s", about="S0."),
        _time("last_arrival_s", about="t_N."),
        _time("safe_end_s", about="S0 + P_N."),
        _time("least_end_s", about="E_lo."),
        _mean("stalls", "stalls", "Stalls longer than 20 ms a plan.", kind=COUNT),
        _mean("p_any_stall", "P(stall)", "Share of the plans that stall at all.", kind=FLAG, bounds=_SHARE),
        _time("stall_s", "stalled", "All stalls of a plan together.", "mean"),
        _time("longest_stall_s", "longest", statistic="mean"),
        _mean(
            "stall_ratio",
            "stall ratio",
            "Stalled share of the time from first action to completion.",
            kind=SHARE,
            bounds=_SHARE,
        ),
        _mean("start_regret", "late start", "max(0, s_1 - S0) / S0.", kind=SHARE, optional=True),
        _mean(
            "start_regret_elastic",
            "over S_lo",
            "max(0, s_1 - S_lo) / S_lo, over the least start that T_max allows.",
            kind=SHARE,
            optional=True,
        ),
        _mean("signed_start_regret", about="(s_1 - S0) / S0.", bounds=_UNBOUND, optional=True),
        _mean(
            "start_regret_of_wait",
            "of wait",
            "max(0, s_1 - S0) / (t_N - S0); absent where t_N = S0.",
            kind=SHARE,
            optional=True,
        ),
        _mean("end_regret", "late end", "(e_N - E) / E with E = S0 + P_N.", kind=SHARE, bounds=_UNBOUND),
        _mean(
            "end_regret_of_wait", about="(e_N - E) / (t_N - S0); absent where t_N = S0.", bounds=_UNBOUND, optional=True
        ),
        _mean(
            "end_regret_elastic",
            "over E_lo",
            "(e_N - E_lo) / E_lo, over the least end that T_min allows.",
            kind=SHARE,
            bounds=_UNBOUND,
        ),
        _time("mean_queue_wait_s", "queued", "s_i - t_i.", "mean"),
        _time("longest_queue_wait_s", "longest", statistic="mean"),
        _time("mean_action_age_s", "age", "s_i - the time of the picture."),
        _time("oldest_action_s", "oldest"),
        _mean("speed_distortion", "distortion", "Durations over nominal ones."),
        _mean("fluidity", "fluidity", "Share of deadlines met (Etalon).", "higher", bounds=_SHARE),
        _mean(
            "rms_jerk",
            "RMS jerk",
            "Of a model: 1 / s^2 at unit speed; mean over the plans whose skills are kept.",
            optional=True,
        ),
        _mean("peak_jerk", "peak jerk", optional=True),
        _mean(
            "sparc",
            "SPARC",
            "Spectral arc length: closer to 0 is smoother.",
            "higher",
            bounds=(None, 0),
            optional=True,
        ),
    )
)


@dataclass(frozen=True, slots=True)
class PlanRow:
    """The columns of a row of `TIMELINES` besides the metrics.

    ``board`` is a profile's name, empty for a given rate. ``mode`` is ``virtual`` (computed), or the clock;
    ``emulated`` is true if no model answered. All times count from ``requested_ns``, 0 in virtual time.
    """

    cell: str
    policy: str
    board: str
    title: str
    mode: str
    emulated: bool
    tokens_per_s: float
    prompt_s: float | None
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    plan: int
    request_id: str
    requested_ns: int
    caution: float | None


TimelineRow: Final = with_fields(
    "TimelineRow",
    "One plan under one policy, with a column a metric. Motion is null for plans whose skills are not kept.",
    PlanRow,
    columns(METRICS.values()),
)


TIMELINES: Final[Table[PlanRow]] = Table("timelines", TimelineRow)
