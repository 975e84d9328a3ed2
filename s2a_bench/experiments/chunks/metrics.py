"""The metrics of acting on chunks: the one table that columns, JSON and its schema, CSV and tables are made of.

A new metric is a row here, and a value under its name in `to_rows.metrics_of`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from s2a_bench.experiments import Better, Metric


@dataclass(frozen=True, slots=True)
class ChunkMetric(Metric):
    """A metric with its column; a row is without it where there is nothing to count.

    ``about`` says what it is, ``least`` and ``most`` between what it lies, ``whole`` that it is a whole number.
    """

    about: str = ""
    least: float | None = 0
    most: float | None = None
    whole: bool = False

    @property
    def schema(self) -> dict[str, Any]:
        """Return what its annotation says."""
        limits = {"minimum": self.least, "maximum": self.most}
        about = {"description": self.about} if self.about else {}
        return {**about, **{key: limit for key, limit in limits.items() if limit is not None}}


def _number(name: str, unit: str, title: str, about: str, better: Better = "lower", **more: Any) -> ChunkMetric:
    return ChunkMetric(name, unit, better, title, "mean", about=about, **more)


def _ticks(name: str, title: str, about: str, **more: Any) -> ChunkMetric:
    return _number(name, "ticks", title, about, **more)


def _share(name: str, title: str, about: str, better: Better = "lower") -> ChunkMetric:
    return _number(name, "", title, about, better, most=1)


def _plant(name: str, unit: str, title: str, about: str, better: Better = "lower") -> ChunkMetric:
    units = "u: the actions' unit, in virtual time the target's standard deviation."
    return _number(name, unit, title, f"{about} {units}", better)


METRICS: Final[Mapping[str, ChunkMetric]] = {
    metric.name: metric
    for metric in (
        _ticks("ticks", "ticks", "Control ticks from the first action on.", better="neither", whole=True),
        _ticks("stall_ticks", "stalled", "Those without an action.", whole=True),
        _number("stall_ticks_per_s", "1/s", "stalls/s", "Stalled ticks a second, from the first action on."),
        _share("stall_share", "stalled", "Share of the ticks that stall."),
        _ticks("longest_stall_ticks", "longest", "The longest stall.", whole=True),
        _number("boundaries", "", "cycles", "From one executed chunk to the next.", "neither", whole=True),
        _number("stalled_cycles", "", "stalled cycles", "Boundaries with a stall.", whole=True),
        _share("p_stall_cycle", "P(stall)", "Share of the boundaries with a stall."),
        _share("p_stall_low", "from", "Its two-sided 95 % interval (Clopper and Pearson), the lower end."),
        _share("p_stall_high", "to", "The upper end."),
        _share("p_stall_closed", "closed form", "What the closed form says of the same delays, where it holds."),
        _ticks("age_ticks_mean", "age", "Of the observation behind an executed action."),
        _ticks("age_ticks_p99", "p99", "Its 99th percentile."),
        _ticks("age_ticks_max", "max", "The greatest."),
        _ticks("age_ticks_blended", "blended", "Its mean where actions are blended: ages weighted as the actions are."),
        _number("reaction_s_mean", "s", "reaction", "From an event to the start of the first tick that knows of it."),
        _number("reaction_s_p99", "s", "p99", "Its 99th percentile."),
        _number("reaction_s_closed", "s", "closed form", "Its mean by the closed form, in ticks, where that holds."),
        _number("first_action_s", "s", "first action", "From the first observation until an action leaves."),
        _number("control_rate_hz", "Hz", "rate", "Executed actions a second, from the first on.", "higher"),
        _ticks("delay_ticks_mean", "d", "Realised d, by the row's convention.", better="neither"),
        _ticks("delay_ticks_p99", "p99", "Its 99th percentile.", better="neither"),
        _ticks("delay_ticks_max", "max", "The greatest.", better="neither"),
        _ticks("delay_assumed_ticks", "assumed", "The d that the mode is ready for: trigger, or `assumed`."),
        _share("p_delay_above", "d above it", "Share of the requests whose d is above the assumed one."),
        _ticks(
            "margin_ticks",
            "margin",
            "The stability margin: all latencies may be so much longer without a stall; -1 where some stalls as it is.",
            better="higher",
            least=-1,
            whole=True,
        ),
        _number(
            "slow_down",
            "",
            "beta",
            "So many times slower actions stall in a share epsilon of the cycles at most, at the greatest trigger.",
            least=1,
        ),
        _number("slower", "", "slower", "So many times slower than it was asked for actions were executed.", least=1),
        _share("thrown_away_share", "thrown away", "Actions never executed, of all."),
        _number("jump_mean", "actions", "jump", "By how many actions the robot is thrown at a boundary."),
        _number("jump_max", "actions", "max", "The greatest."),
        _plant("tracking_rms", "u", "tracking", "Position of the plant less the target's, root mean square."),
        _plant("tracking_rms_ideal", "u", "ideal", "The same, asked in every tick and answered at once.", "neither"),
        _plant("jerk_rms", "u/s^3", "jerk", "Change of acceleration over a control period, by it; root mean square."),
        _plant("jerk_rms_ideal", "u/s^3", "ideal", "The same, asked in every tick and answered at once.", "neither"),
        _plant("boundary_jump_mean", "u", "jump", "From a chunk's last executed action to the next one's first."),
        _plant("boundary_jump_p99", "u", "p99", "Its 99th percentile."),
        _plant("action_step_mean", "u", "step", "From one action to the next within a chunk.", "neither"),
        _ticks("blocked_ticks", "blocked", "Ticks in which the control loop waits for an answer.", whole=True),
        _share("agreement", "as computed", "Live: share of the ticks as virtual time has them.", "higher"),
        _number("jitter_s_p50", "s", "jitter", "Live: how long after it was due an action left, the median."),
        _number("jitter_s_p99", "s", "p99", "Its 99th percentile."),
        _number("jitter_s_max", "s", "max", "The greatest."),
        _ticks("late_ticks", "late", "Live: ticks whose action left a whole tick late or more.", whole=True),
        _number("blocked_s_p99", "s", "blocked", "Live: what asking and sending took of a tick, 99th percentile."),
        _number("blocked_s_max", "s", "max", "The greatest."),
        _number("bytes_up_per_s", "bytes/s", "up", "Live: what the pictures weigh that leave in a second."),
    )
}
"""The metrics by their names, in the order of their columns."""
