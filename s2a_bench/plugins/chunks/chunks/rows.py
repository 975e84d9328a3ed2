"""The rows of a run of chunks, and its metric table, from which columns, JSON, schema, CSV and tables follow.

A new metric is a row of the table, and a value under its name in `build_rows.metrics_of`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

from s2a_bench.experiments import COUNT, Better, Metric, by_name, columns, number, share
from s2a_bench.store.schema import Count, Many, NonNegative, Positive, Table, about, with_fields


def _ticks(name: str, title: str, about: str, **more: Any) -> Metric:
    return number(name, "ticks", title, about, **more)


def _plant(name: str, unit: str, title: str, about: str, better: Better = "lower") -> Metric:
    units = "u: the actions' unit, in virtual time the target's standard deviation."
    return number(name, unit, title, f"{about} {units}", better)


METRICS: Final[Mapping[str, Metric]] = by_name(
    (
        _ticks("ticks", "ticks", "Control ticks from the first action on.", better="neither", kind=COUNT),
        _ticks("stall_ticks", "stalled", "Those without an action.", kind=COUNT),
        number("stall_ticks_per_s", "1/s", "stalls/s", "Stalled ticks a second, from the first action on."),
        share("stall_share", "stalled", "Share of the ticks that stall."),
        _ticks("longest_stall_ticks", "longest", "The longest stall.", kind=COUNT),
        number("boundaries", "", "cycles", "From one executed chunk to the next.", "neither", kind=COUNT),
        number("stalled_cycles", "", "stalled cycles", "Boundaries with a stall.", kind=COUNT),
        share("p_stall_cycle", "P(stall), %", "Share of the boundaries with a stall."),
        share("p_stall_low", "from", "Its two-sided 95 % interval (Clopper and Pearson), the lower end."),
        share("p_stall_high", "to", "The upper end."),
        share("p_stall_closed", "form", "What the closed form says of the same delays, where it holds."),
        _ticks("age_ticks_mean", "age", "Of the observation behind an executed action."),
        _ticks("age_ticks_p99", "p99", "Its 99th percentile."),
        _ticks("age_ticks_max", "max", "The greatest."),
        _ticks("age_ticks_blended", "blended", "Its mean with blended actions: ages weighted as the actions are."),
        number("reaction_s_mean", "s", "react (ms)", "From an event to the start of the first tick that knows of it."),
        number("reaction_s_p99", "s", "p99", "Its 99th percentile."),
        number("reaction_s_closed", "s", "form", "Its mean by the closed form of the same delays, where it holds."),
        number("first_action_s", "s", "first action", "From the first observation until an action leaves."),
        number("control_rate_hz", "Hz", "Hz", "Executed actions a second, from the first on.", "higher"),
        _ticks("delay_ticks_mean", "d", "Realised d, by the row's convention.", better="neither"),
        _ticks("delay_ticks_p99", "p99", "Its 99th percentile.", better="neither"),
        _ticks("delay_ticks_max", "max", "The greatest.", better="neither"),
        _ticks("delay_assumed_ticks", "assumed", "The d that the mode is ready for: trigger, or `assumed`."),
        share("p_delay_above", "above, %", "Share of the requests whose d is above the assumed one."),
        _ticks(
            "margin_ticks",
            "margin",
            "The stability margin: all latencies may be longer by this without a stall; -1 where some stall already.",
            better="higher",
            bounds=(-1, None),
            kind=COUNT,
        ),
        number(
            "slow_down",
            "",
            "beta",
            "The least slow-down of actions at which at most a share epsilon of the cycles stalls, at the greatest m.",
            bounds=(1, None),
        ),
        number(
            "slower",
            "",
            "slower",
            "By how many times slower than `control_hz` actions were executed.",
            bounds=(1, None),
        ),
        share("thrown_away_share", "unused, %", "Actions never executed, of all."),
        number("jump_mean", "actions", "jump", "By how many actions the robot is thrown at a boundary."),
        number("jump_max", "actions", "max", "The greatest."),
        _plant("tracking_rms", "u", "tracking", "Position of the plant less the target's, root mean square."),
        _plant("tracking_rms_ideal", "u", "ideal", "The same, with a request in every tick and no latency.", "neither"),
        _plant("jerk_rms", "u/s^3", "jerk", "Change of acceleration over a control period, by it; root mean square."),
        _plant("jerk_rms_ideal", "u/s^3", "ideal", "The same, with a request in every tick and no latency.", "neither"),
        _plant("boundary_jump_mean", "u", "jump", "From a chunk's last executed action to the next one's first."),
        _plant("boundary_jump_p99", "u", "p99", "Its 99th percentile."),
        _plant("action_step_mean", "u", "step", "From one action to the next within a chunk.", "neither"),
        _ticks("blocked_ticks", "blocked", "Ticks in which the control loop waits for an answer.", kind=COUNT),
        share("agreement", "alike, %", "Live: share of the ticks as the mode's arrays have them.", "higher"),
        number("jitter_s_p50", "s", "jitter (ms)", "Live: delay of an action after its due time, the median."),
        number("jitter_s_p99", "s", "p99", "Its 99th percentile."),
        number("jitter_s_max", "s", "max", "The greatest."),
        _ticks("late_ticks", "late", "Live: ticks whose action left a whole tick late or more.", kind=COUNT),
        number("blocked_s_p99", "s", "busy (ms)", "Live: time of requests and sending in a tick, 99th percentile."),
        number("blocked_s_max", "s", "max", "The greatest."),
        number("bytes_up_per_s", "bytes/s", "MB/s up", "Live: bytes of pictures sent in a second."),
    )
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AboutCell:
    """The columns of a row of `CHUNKS` besides the metrics."""

    cell: str
    mode: Annotated[str, about("With the parameters that are not at their defaults.")]
    rule: Annotated[str, about("The rule of the trigger: calibrated, tracked, ...; given where the mode names it.")]
    latency: Annotated[str, about("The source of the latencies, as in --latency.")]
    latency_s: Annotated[NonNegative, about("The mean.")]
    latency_s_p99: NonNegative
    rounding: Annotated[str, about("The convention for d: floor or ceil of latency over control tick.")]
    delta_t_s: Positive
    horizon: Annotated[Many, about("H, actions of a chunk.")]
    execution_horizon: Annotated[Count, about("s, planned ticks of a chunk's execution.")]
    requests: Many
    trigger: Annotated[
        NonNegative | None, about("m, actions left at the next request; its mean where a rule moves it.")
    ] = None


ChunkRow: Final = with_fields(
    "ChunkRow",
    "A mode and rule under a source of latencies, with a column a metric.",
    AboutCell,
    columns(METRICS.values()),
)


@dataclass(frozen=True, slots=True)
class TickRow:
    """One control tick: the request of the action's chunk, its index there, and the age of the observation.

    ``chunk``, ``index`` and ``age_ticks`` are null for a tick without an action, ``stalled`` if the robot had begun.
    """

    cell: str
    tick: int
    chunk: int | None
    index: int | None
    age_ticks: int | None
    stalled: bool
    late_ns: int | None = None
    """Delay of the action after its due time; null in virtual time."""


@dataclass(frozen=True, slots=True)
class RequestRow:
    """One request: its time, the latency of its chunk, and from which tick and action that was executed.

    ``start_tick`` and ``first_index`` are null if no action was executed; ``jump`` counts actions skipped, negative for
    actions repeated.
    """

    cell: str
    request: int
    request_tick: int
    latency_ns: int
    delay_ticks: int
    start_tick: int | None
    first_index: int | None
    executed: int
    thrown_away: int
    stall_ticks: int
    jump: int | None
    request_id: str | None = None
    """The id of its sample; null in virtual time."""


@dataclass(frozen=True, slots=True)
class TriggerRow:
    """One trigger of queue under one source of latencies; ``p_stall_closed`` is the share of d above it."""

    latency: str
    mode: str
    execution_horizon: int
    trigger: int
    boundaries: int
    p_stall_cycle: float
    p_stall_low: float
    p_stall_high: float
    p_stall_closed: float | None
    age_ticks_mean: float


@dataclass(frozen=True, slots=True)
class ReactionRow:
    """A quantile of a cell's reaction times: simulated, and by the closed form where it holds."""

    cell: str
    share: float
    reaction_s: float
    closed_s: float | None


@dataclass(frozen=True, slots=True)
class MeanRow:
    """A mode at one mean latency: the source's latencies, all scaled by one factor."""

    latency: str
    mode: str
    latency_s: float
    stall_share: float | None
    tracking_rms: float | None
    tracking_rms_ideal: float | None
    jerk_rms: float | None
    jerk_rms_ideal: float | None


CHUNKS: Final[Table[AboutCell]] = Table("chunks", ChunkRow)
TICKS: Final[Table[TickRow]] = Table("chunk_ticks", TickRow)
REQUESTS: Final[Table[RequestRow]] = Table("chunk_requests", RequestRow)
TRIGGERS: Final[Table[TriggerRow]] = Table("chunk_triggers", TriggerRow)
REACTIONS: Final[Table[ReactionRow]] = Table("chunk_reactions", ReactionRow)
MEANS: Final[Table[MeanRow]] = Table("chunk_means", MeanRow)
