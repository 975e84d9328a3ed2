"""The options of a capacity run: the robots, the limit and the search; measured, the requests, or predicted."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator

from s2a_bench.errors import UsageError
from s2a_bench.harness.config import GROUPED, sampling
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, group, option
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode
from s2a_bench.plugins.chunks.options import ControlOptions, LoopRequests, ServedOptions, acting_modes
from s2a_bench.transport import ACTIONS, TOKENS

PLAN_EVERY_S: Final = 2.0
FEWEST_PLANS: Final = 3
"""The fewest plans of a robot in the measured time."""
SETTLE_S: Final = 5.0
LIMITS: Final = "stalled=1%, latency_p99=300ms, ttft_p99=300ms, age_p99=200ms; p50 as well as p99"
_LIMIT: Final = re.compile(r"(stalled)=(\d+\.?\d*)%?|((?:latency|ttft|age)_p(50|99))=(\d+\.?\d*)(ms|s)")


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit on fleets: at most ``share`` of the values of a metric are above ``value``.

    The values of ``stalled`` are 1 for a tick, or a plan, that stalls, else 0; all others are in ns.
    """

    column: str
    """Its column in the rows of fleets."""
    value: float
    """The greatest allowed value of the column."""
    share: float

    @staticmethod
    def read(written: str) -> Limit:
        """Read ``METRIC=VALUE``; raises UsageError."""
        match = _LIMIT.fullmatch(written)
        if match is None:
            raise UsageError(f"`limit`: '{written}' should be one of {LIMITS}")
        if match[1]:
            share = float(match[2]) / (100 if written.endswith("%") else 1)
            if share >= 1:
                raise UsageError(f"`limit`: '{written}' allows every tick to stall; write 1% or 0.01")
            return Limit("stalled", share, share)
        value_ns = float(match[5]) * (1e9 if match[6] == "s" else 1e6)
        return Limit(f"{match[3]}_ns", value_ns, 1 - int(match[4]) / 100)


@dataclass(frozen=True, slots=True)
class RobotLoad:
    """The load of each robot of a fleet: chunks in an acting mode, a plan per period, or a closed loop."""

    setting: ControlSetting
    mode: Mode | None = None
    """None: robots without a control clock."""
    name: str = ""
    """The canonical name of the acting mode."""
    seed: int = 0
    every_ns: int = 0
    """The period of a robot's plans; 0 and no mode: closed loop."""
    think_ns: int = 0
    """Closed loop: from an answer to the next request."""
    episode_ns: int = 0
    """The robots start together every so often; 0: once, at random moments of their first cycle."""
    settle_ns: int = 0
    """The time after a start that is not measured."""

    @property
    def cycle_ns(self) -> int:
        if self.mode is not None:
            return self.mode.execution_horizon(self.setting) * self.setting.period_ns
        return self.every_ns or self.think_ns

    def of(self, server: str) -> str:
        """Return the name of the cell of these robots and a server."""
        return f"{server}, {self.name}" if self.name else server

    def beyond_alone(self, limit: Limit | None) -> bool:
        """Return True if only stalls beyond those of one robot alone count, as in a mode that blocks."""
        return self.mode is not None and self.mode.blocks and limit is not None and limit.column == "stalled"

    def limit_text(self, limit: Limit) -> str:
        if limit.column != "stalled":
            return f"{limit.column.removesuffix('_ns').replace('_', ' ')} of at most {limit.value / 1e6:g} ms"
        beyond = " beyond those of one robot alone" if self.beyond_alone(limit) else ""
        return f"at most {limit.share * 100:g} % stalled {'plans' if self.mode is None else 'ticks'}{beyond}"


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """The fleets to try, the time for each, and their limit."""

    numbers: Sequence[int]
    """The numbers of robots, ascending."""
    bisects: bool
    """Whether the search ends at the first fleet beyond the limit, and bisects from there."""
    limit: Limit | None
    look_ns: int
    """The shortest time for which a fleet acts, and the time between looks at it."""
    looks: int

    @property
    def most_fleets(self) -> int:
        """Return the most fleets of a search, one robot alone included."""
        bisected = math.ceil(math.log2(self.numbers[-1] / self.numbers[0])) if self.bisects else 0
        return len({1, *self.numbers}) + bisected

    @property
    def confidence(self) -> float:
        """Return the confidence of one look, so that all looks of a search are right with 95 % (Bonferroni)."""
        return 1 - 0.05 / (self.most_fleets * self.looks)


class CapacityRequests(LoopRequests):
    engine: EngineConfig = group(
        EngineConfig, only=set(EngineConfig.model_fields) - {"answer", "horizon", "latency", "batch"}
    )
    sample_resources_hz: float = sampling(2.0)


class CapacityOptions(ControlOptions):
    """A fleet of robots, and what it may not exceed."""

    PANEL: ClassVar[str] = "Fleet"
    MOST_ROBOTS: ClassVar[int]

    modes: Names = acting_modes(("queue?trigger=8",))
    robots: Annotated[str, BeforeValidator(str, json_schema_input_type=str | int)] = option(
        "1..64", "FROM..TO is searched, doubling, then by bisection; a number or a list is tried", first=True
    )
    limit: str = option("stalled=1%", f"{LIMITS}; empty text: none, every number of robots is tried", first=True)
    seconds: float = option(10.0, "the shortest time for which a fleet acts, and the time between looks", gt=0, le=3600)
    looks: int = option(4, "the most looks at a fleet before it counts as undecided", ge=1, le=100)
    settle_s: float | None = option(
        None,
        "seconds of a fleet that are left out, and marked [default: 5; with --episodes 0]",
        flag="settle",
        ge=0,
        le=3600,
    )
    episodes_s: float = option(
        0.0, "the robots start together every so many seconds; 0: once, at random moments", flag="episodes", ge=0
    )
    closed_loop: bool = option(False, "clients without a control clock: they request when they have the answer")
    think_s: float = option(0.0, "--closed-loop: from an answer to the next request", flag="think", ge=0, le=3600)
    plan_every_s: float | None = option(
        None,
        "robots request a plan of tokens every so many seconds [default: 2 where a server has no actions]",
        flag="plan-every",
        gt=0,
        le=3600,
    )

    @property
    def numbers(self) -> Sequence[int]:
        """The numbers of robots to try, ascending; of FROM..TO the powers of two times FROM, then TO."""
        low, _, high = self.robots.partition("..")
        try:
            named = sorted({int(each) for each in (*low.split(","), *high.split(",")) if each.strip()})
        except ValueError:
            named = []
        if not named or named[0] < 1:
            raise UsageError(f"`robots`: '{self.robots}' should be 1 or more: a number, a list, or FROM..TO")
        if not high:
            return tuple(named)
        first, last = named[0], named[-1]
        return (*(first << step for step in range((last // first).bit_length()) if first << step < last), last)

    @cached_property
    def search(self) -> SearchPlan:
        """The search; by default without a limit for clients without a clock."""
        wanted = self.limit if "limit" in self.model_fields_set or not self.closed_loop else ""
        limit = Limit.read(wanted) if wanted else None
        bisects = ".." in self.robots and limit is not None
        return SearchPlan(self.numbers, bisects, limit, round(self.seconds * 1e9), self.looks)

    @property
    def loads(self) -> Sequence[RobotLoad]:
        """The loads of the robots: one for each acting mode, or the one load without chunks."""
        episode_ns = round(self.episodes_s * 1e9)
        load = RobotLoad(self.setting, seed=self.seed, episode_ns=episode_ns, settle_ns=self.settle_ns)
        if self.load == "chunks":
            return [replace(load, mode=mode, name=name) for name, mode in self.control.modes.items()]
        if self.load == "plans":
            return [replace(load, every_ns=self.plan_ns)]
        return [replace(load, think_ns=round(self.think_s * 1e9))]

    @property
    def settle_ns(self) -> int:
        by_default_s = 0.0 if self.episodes_s else SETTLE_S
        return round((by_default_s if self.settle_s is None else self.settle_s) * 1e9)

    @property
    def answer(self) -> str:
        return ACTIONS if self.plan_every_s is None else TOKENS

    @cached_property
    def load(self) -> Literal["chunks", "plans", "closed"]:
        """The kind of load; robots of a server without actions request plans."""
        if self.closed_loop:
            return "closed"
        return "chunks" if self.answer == ACTIONS else "plans"

    @property
    def plan_ns(self) -> int:
        return round((self.plan_every_s or PLAN_EVERY_S) * 1e9)

    def check(self) -> None:
        super().check()
        if self.numbers[-1] > self.MOST_ROBOTS:
            raise UsageError(f"`robots`: {self.numbers[-1]} are more than {self.MOST_ROBOTS}")
        if self.episodes_s and (self.closed_loop or self.episodes_s * self.control_hz < 2):  # noqa: PLR2004
            raise UsageError(f"`episodes`: {self.episodes_s:g} s need a control clock, and two of its ticks")
        if self.episodes_s and self.settle_ns >= self.episodes_s * 1e9:
            raise UsageError(f"`settle`: {self.settle_s:g} s leave nothing of an episode of {self.episodes_s:g} s")
        limit, fields = self.search.limit, self.model_fields_set
        if "think_s" in fields and not self.closed_loop:
            raise UsageError("`think` needs `closed_loop`")
        if "modes" in fields and self.load != "chunks":
            raise UsageError("`modes` are ways to act on chunks of actions; leave them out without chunks")
        least_s = FEWEST_PLANS * self.plan_ns / 1e9
        acts_s = self.episodes_s - self.settle_ns / 1e9 if self.episodes_s else self.seconds
        if self.load == "plans" and acts_s < least_s:
            name, every = "episodes" if self.episodes_s else "seconds", f"one plan every {self.plan_ns / 1e9:g} s"
            raise UsageError(f"`{name}`: {acts_s:g} s are too short for {every}; take {least_s:g} or more")
        if limit is None:
            return
        if limit.column.startswith("age") and self.load != "chunks":
            raise UsageError("`limit`: only an action has an age; take latency_p99, ttft_p99 or stalled")
        if limit.column == "stalled" and self.load == "closed":
            raise UsageError("`limit`: a client without a clock never stalls; take latency_p99=300ms or ttft_p99=300ms")

    def to_manifest(self) -> dict[str, Any]:
        return {
            **super().to_manifest(),
            "load": self.load,
            **({"plan_every_s": self.plan_ns / 1e9} if self.load == "plans" else {}),
            "settle_ns": self.settle_ns,
        }


class CapacityMeasured(CapacityOptions, ServedOptions):
    """A fleet of robots at a server."""

    MOST_ROBOTS: ClassVar[int] = 1_000
    """Each has a connection and a thread."""

    processes: int = option(1, "processes over which the robots are spread", ge=1, le=256)
    ray: str = option("", "spread the processes over a Ray cluster: its ADDRESS, auto, or local; needs --url")
    requests: CapacityRequests = group(
        CapacityRequests, only=(*GROUPED, "prompt", "max_tokens"), first=("transports", "url")
    )

    @property
    def answer(self) -> str:
        able = all(ACTIONS in each.capabilities.answer_kinds for each in self.requests.pipelines)
        return ACTIONS if able and self.plan_every_s is None else TOKENS

    def check(self) -> None:
        super().check()
        if several := [name for name, each in self.control.modes.items() if each.several]:
            raise UsageError(
                f"`modes`: {several[0]} has several requests under way, a robot one connection; `predict` it instead"
            )
        if self.ray and not all(each.options.external_address for each in self.requests.pipelines):
            raise UsageError("`ray`: robots on other hosts need a server that they reach; name it with `url`")


class CapacityPredicted(CapacityOptions):
    """A fleet of robots in virtual time."""

    virtual: ClassVar[bool] = True
    MOST_ROBOTS: ClassVar[int] = 10_000

    predict: str = option(
        ...,
        "predict, in virtual time: the run folder of one robot, or service times as in --latency",
        first=True,
        min_length=1,
    )
    servers: int = option(1, "servers that share one queue", ge=1, le=1000)
    batch: Path | None = option(
        None, "CSV of a batching server, columns batch and latency_ms, that of so many requests together"
    )
