"""The tables of a capacity run: fleets, the robots of each, their requests, and the knee of each cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

from s2a_bench.bounds import Count, Many, NonNegative, about
from s2a_bench.plugins.chunks.capacity.metrics import FleetMetrics
from s2a_bench.store.schema import Table

TWIN: Final = ", instant"
"""Suffix of a pipeline's name for its instant server."""
Source = Literal["measured", "predicted", "twin"]
Verdict = Literal["below", "above", "undecided", "none"]


@dataclass(frozen=True, kw_only=True)
class AboutFleet:
    """The columns of a row of `FLEETS` besides the metrics."""

    cell: Annotated[str, about("The pipeline, and the mode of chunks.")]
    source: Annotated[Source, about("twin: the same robots against an instant server, which checks the generator.")]
    robots: Annotated[Many, about("N.")]
    seconds: Annotated[NonNegative, about("How long it acted, without settling.")]
    looks: Annotated[Count, about("After how many looks it was decided, or given up.")]
    verdict: Annotated[Verdict, about("Where the interval lies against the limit; none: no limit.")]
    within: Annotated[bool, about("Whether the value itself keeps to the limit.")]
    clean: Annotated[
        bool,
        about(
            "Whether its own ticks at p99 were within 5 % of one, true of twins; in JSON and CSV also its twin within "
            "the limit."
        ),
    ]


@dataclass(frozen=True, kw_only=True)
class FleetRow(FleetMetrics, AboutFleet):
    """N robots on one server."""

    as_stored: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class AboutRobot:
    """Whose row it is, of `ROBOTS` or `REQUESTS`."""

    cell: str
    source: str
    robots: int
    robot: int


@dataclass(frozen=True, kw_only=True)
class RobotRow(FleetMetrics, AboutRobot):
    """One robot of a fleet in an episode."""


@dataclass(frozen=True, kw_only=True)
class RequestRow(AboutRobot):
    """One request of a robot: its intended time after its first tick, and its latency, null without an answer."""

    intended_ns: int
    latency_ns: int | None
    settling: bool
    """Whether it is left out, as the fleet settles."""


@dataclass(frozen=True, slots=True)
class KneeRow:
    """How many robots a server carries, and from where to where that is sure; ``high`` null: no fleet was too large.

    Predicted, it has no interval: ``low`` is ``robots``, ``high`` is less than the next fleet that was tried.
    ``driven`` is the largest fleet that the generator drives; null in virtual time.
    """

    cell: str
    source: str
    limit: str
    robots: int
    low: int
    high: int | None
    driven: int | None


FLEETS: Final[Table[FleetRow]] = Table("capacity", FleetRow)
ROBOTS: Final[Table[RobotRow]] = Table("capacity_robots", RobotRow)
REQUESTS: Final[Table[RequestRow]] = Table("capacity_requests", RequestRow)
KNEES: Final[Table[KneeRow]] = Table("capacity_knees", KneeRow)
