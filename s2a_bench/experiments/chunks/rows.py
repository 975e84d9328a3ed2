"""The rows of a run of chunks: cells, the first ticks of each, and what is varied besides."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Final

from s2a_bench.experiments.chunks.metrics import METRICS
from s2a_bench.store.bounds import Count, Many, NonNegative, Positive, about
from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True, kw_only=True)
class AboutCell:
    """What a row of `CHUNKS` says of its cell besides the metrics."""

    cell: str
    mode: Annotated[str, about("With the parameters that are not at their defaults.")]
    rule: Annotated[str, about("What chose the trigger: calibrated, tracked, ...; given where the mode names it.")]
    latency: Annotated[str, about("Where latencies come from, as --latency names it.")]
    latency_s: Annotated[NonNegative, about("The mean.")]
    latency_s_p99: NonNegative
    rounding: Annotated[str, about("The convention for d: floor or ceil of latency over control tick.")]
    delta_t_s: Positive
    horizon: Annotated[Many, about("H, actions of a chunk.")]
    execution_horizon: Annotated[Count, about("s, ticks that a chunk is to be executed for.")]
    requests: Many
    trigger: Annotated[
        NonNegative | None, about("m, actions left at the next request; its mean where a rule moves it.")
    ] = None


ChunkRow: Final = make_dataclass(
    "ChunkRow",
    [
        (name, Annotated[(int if metric.whole else float) | None, metric.schema], field(default=None))
        for name, metric in METRICS.items()
    ],
    bases=(AboutCell,),
    frozen=True,
    slots=True,
    kw_only=True,
)
"""A mode and rule under a source of latencies, with a column a metric."""


@dataclass(frozen=True, slots=True)
class TickRow:
    """One control tick: which request's chunk the action was from, its place there, and the age of the observation.

    ``chunk``, ``index`` and ``age_ticks`` are null for a tick without an action; ``stalled`` if the robot had begun.
    """

    cell: str
    tick: int
    chunk: int | None
    index: int | None
    age_ticks: int | None
    stalled: bool
    late_ns: int | None = None
    """How long after it was due the action left; null in virtual time."""


@dataclass(frozen=True, slots=True)
class RequestRow:
    """One request: when it left, how long its chunk took, when and from which action on it was executed.

    ``start_tick`` and ``first_index`` are null where no action of it was; ``jump`` is by how many actions the robot was
    thrown ahead, or back where below 0.
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
    """Of its sample; null in virtual time."""


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
class StabilityRow:
    """A mode at one mean latency and execution horizon: the source's latencies, all longer or shorter by one factor."""

    latency: str
    mode: str
    latency_s: float
    execution_horizon: int
    requests: int
    stall_share: float | None
    p_stall_cycle: float | None


@dataclass(frozen=True, slots=True)
class ReactionRow:
    """A quantile of a cell's reaction times: as simulated, and by the closed form where it holds."""

    cell: str
    share: float
    reaction_s: float
    closed_s: float | None


@dataclass(frozen=True, slots=True)
class SmoothnessRow:
    """A mode at one mean latency, on a plant: the source's latencies, all longer or shorter by one factor."""

    latency: str
    mode: str
    latency_s: float
    tracking_rms: float | None
    tracking_rms_ideal: float | None
    jerk_rms: float | None
    jerk_rms_ideal: float | None
    boundary_jump_mean: float | None


CHUNKS: Final[Table[AboutCell]] = Table("chunks", ChunkRow)
"""One row a mode, rule and source of latencies."""
TICKS: Final[Table[TickRow]] = Table("chunk_ticks", TickRow)
"""One row a control tick, the first of each cell."""
REQUESTS: Final[Table[RequestRow]] = Table("chunk_requests", RequestRow)
"""One row a request that left within those ticks."""
TRIGGERS: Final[Table[TriggerRow]] = Table("chunk_triggers", TriggerRow)
"""One row a trigger and source of latencies."""
STABILITY: Final[Table[StabilityRow]] = Table("chunk_stability", StabilityRow)
"""One row a mean latency and execution horizon."""
REACTIONS: Final[Table[ReactionRow]] = Table("chunk_reactions", ReactionRow)
"""One row a cell and quantile."""
SMOOTHNESS: Final[Table[SmoothnessRow]] = Table("chunk_smoothness", SmoothnessRow)
"""One row a mode and mean latency."""
