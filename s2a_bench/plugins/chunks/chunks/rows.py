"""The rows of a run of chunks; their annotations are the metrics: JSON, schema, CSV and tables follow.

A new metric is a column, and a value under its name in `build_rows.metrics_of`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Final

from s2a_bench.bounds import Count, Many, NonNegative, Positive, about
from s2a_bench.experiments.cells import mean, metrics_of, share
from s2a_bench.store.schema import Table

_ticks = partial(mean, unit="ticks")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkRow:
    """An acting mode and a rule under a source of latencies."""

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
    ticks: Annotated[int | None, _ticks("ticks", "Control ticks from the first action on.", better="neither")]
    stall_ticks: Annotated[int | None, _ticks("stalled", "Those without an action.")]
    stall_ticks_per_s: Annotated[
        float | None, mean("stalls/s", "Stalled ticks a second, from the first action on.", unit="1/s")
    ]
    stall_share: Annotated[float | None, share("stalled", "Share of the ticks that stall.")]
    longest_stall_ticks: Annotated[int | None, _ticks("longest", "The longest stall.")]
    boundaries: Annotated[int | None, mean("cycles", "From one executed chunk to the next.", better="neither")]
    stalled_cycles: Annotated[int | None, mean("stalled cycles", "Boundaries with a stall.")]
    p_stall_cycle: Annotated[float | None, share("P(stall), %", "Share of the boundaries with a stall.")]
    p_stall_low: Annotated[
        float | None, share("from", "Its two-sided 95 % interval (Clopper and Pearson), the lower end.")
    ]
    p_stall_high: Annotated[float | None, share("to", "The upper end.")]
    p_stall_closed: Annotated[
        float | None, share("form", "What the closed form says of the same delays, where it holds.")
    ]
    age_ticks_mean: Annotated[float | None, _ticks("age", "Of the observation behind an executed action.")]
    age_ticks_p99: Annotated[float | None, _ticks("p99", "Its 99th percentile.")]
    age_ticks_max: Annotated[float | None, _ticks("max", "The greatest.")]
    age_ticks_blended: Annotated[
        float | None, _ticks("blended", "Its mean with blended actions: ages weighted as the actions are.")
    ]
    reaction_s_mean: Annotated[
        float | None, mean("react (ms)", "From an event to the start of the first tick that knows of it.", unit="s")
    ]
    reaction_s_p99: Annotated[float | None, mean("p99", "Its 99th percentile.", unit="s")]
    reaction_s_closed: Annotated[
        float | None, mean("form", "Its mean by the closed form of the same delays, where it holds.", unit="s")
    ]
    first_action_s: Annotated[
        float | None, mean("first action", "From the first observation until an action leaves.", unit="s")
    ]
    control_rate_hz: Annotated[
        float | None, mean("Hz", "Executed actions a second, from the first on.", unit="Hz", better="higher")
    ]
    delay_ticks_mean: Annotated[float | None, _ticks("d", "Realised d, by the row's convention.", better="neither")]
    delay_ticks_p99: Annotated[float | None, _ticks("p99", "Its 99th percentile.", better="neither")]
    delay_ticks_max: Annotated[float | None, _ticks("max", "The greatest.", better="neither")]
    delay_assumed_ticks: Annotated[
        float | None, _ticks("assumed", "The d that the mode is ready for: trigger, or `assumed`.")
    ]
    p_delay_above: Annotated[float | None, share("above, %", "Share of the requests whose d is above the assumed one.")]
    margin_ticks: Annotated[
        int | None,
        _ticks(
            "margin",
            "The stability margin: all latencies may be longer by this without a stall; -1 where some stall already.",
            better="higher",
            bounds=(-1, None),
        ),
    ]
    slow_down: Annotated[
        float | None,
        mean(
            "beta",
            "The least slow-down of actions at which at most a share epsilon of the cycles stalls, at the greatest m.",
            bounds=(1, None),
        ),
    ]
    slower: Annotated[
        float | None,
        mean("slower", "By how many times slower than `control_hz` actions were executed.", bounds=(1, None)),
    ]
    thrown_away_share: Annotated[float | None, share("unused, %", "Actions never executed, of all.")]
    jump_mean: Annotated[
        float | None, mean("jump", "By how many actions the robot is thrown at a boundary.", unit="actions")
    ]
    jump_max: Annotated[float | None, mean("max", "The greatest.", unit="actions")]
    blocked_ticks: Annotated[int | None, _ticks("blocked", "Ticks in which the control loop waits for an answer.")]
    agreement: Annotated[
        float | None, share("alike, %", "Live: share of the ticks as the mode's arrays have them.", better="higher")
    ]
    jitter_s_p50: Annotated[
        float | None, mean("jitter (ms)", "Live: delay of an action after its due time, the median.", unit="s")
    ]
    jitter_s_p99: Annotated[float | None, mean("p99", "Its 99th percentile.", unit="s")]
    jitter_s_max: Annotated[float | None, mean("max", "The greatest.", unit="s")]
    late_ticks: Annotated[int | None, _ticks("late", "Live: ticks whose action left a whole tick late or more.")]
    blocked_s_p99: Annotated[
        float | None, mean("busy (ms)", "Live: time of requests and sending in a tick, 99th percentile.", unit="s")
    ]
    blocked_s_max: Annotated[float | None, mean("max", "The greatest.", unit="s")]
    bytes_up_per_s: Annotated[
        float | None, mean("MB/s up", "Live: bytes of pictures sent in a second.", unit="bytes/s")
    ]


METRICS: Final = metrics_of(ChunkRow)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkCell(ChunkRow):
    """A mode of acting on chunks under one source of latencies, in ``--json``."""

    emulated: Annotated[bool, about("Whether latencies were given or drawn, in virtual time or by the server.")]


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


CHUNKS: Final[Table[ChunkRow]] = Table("chunks", ChunkRow)
TICKS: Final[Table[TickRow]] = Table("chunk_ticks", TickRow)
REQUESTS: Final[Table[RequestRow]] = Table("chunk_requests", RequestRow)
TRIGGERS: Final[Table[TriggerRow]] = Table("chunk_triggers", TriggerRow)
REACTIONS: Final[Table[ReactionRow]] = Table("chunk_reactions", ReactionRow)
MEANS: Final[Table[MeanRow]] = Table("chunk_means", MeanRow)
