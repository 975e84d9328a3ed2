"""The options of a capacity run: the robots, the limit, the search, and the requests of a measured run."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, group, option
from s2a_bench.plugins.chunks.options import SHOWN, ControlOptions, LoopRequests, acting_modes
from s2a_bench.transport import ACTIONS, TOKENS

MOST_ROBOTS: Final = 10_000
MOST_CONNECTIONS: Final = 1_000
"""Robots of a measured run, each with a connection and a thread."""
PLAN_EVERY_S: Final = 2.0
FEWEST_PLANS: Final = 3
"""Of a robot, in the time that counts."""
SETTLE_S: Final = 5.0
LIMITS: Final = "stalled=1%, latency_p99=300ms, ttft_p99=300ms, age_p99=200ms; p50 as well as p99"
_LIMIT: Final = re.compile(r"(stalled)=(\d+\.?\d*)%?|((?:latency|ttft|age)_p(50|99))=(\d+\.?\d*)(ms|s)")


@dataclass(frozen=True, slots=True)
class Limit:
    """What a fleet may not exceed: at most ``share`` of the values of a metric are above ``value``.

    The values of ``stalled`` are 1 for a tick, or a plan, that stalls, else 0; all others are in ns.
    """

    column: str
    """Its column in the rows of fleets."""
    value: float
    """The greatest allowed value of the column."""
    share: float

    @staticmethod
    def read(written: str) -> Limit:
        """Read ``METRIC=VALUE``; raises ValueError."""
        found = _LIMIT.fullmatch(written)
        if found is None:
            raise ValueError(f"'{written}' should be one of {LIMITS}")
        if found[1]:
            share = float(found[2]) / (100 if written.endswith("%") else 1)
            if share >= 1:
                raise ValueError(f"'{written}' allows every tick to stall; write 1% or 0.01")
            return Limit("stalled", share, share)
        value_ns = float(found[5]) * (1e9 if found[6] == "s" else 1e6)
        return Limit(f"{found[3]}_ns", value_ns, 1 - int(found[4]) / 100)

    @property
    def text(self) -> str:
        if self.column == "stalled":
            return f"at most {self.share * 100:g} % stalled"
        return f"{self.column.removesuffix('_ns').replace('_', ' ')} of at most {self.value / 1e6:g} ms"


class CapacityRequests(LoopRequests):
    engine: EngineConfig = group(EngineConfig, only=set(EngineConfig.model_fields) - {"answer", "horizon", "latency"})
    sample_resources_hz: float = option(
        2.0, "readings a second of CPU, memory, GPU and power beside the run; 0: none", flag="sample-resources", ge=0
    )


class CapacityConfig(ControlOptions):
    """A fleet of robots, and what it may not exceed."""

    PANEL: ClassVar[str] = "Fleet"

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
    processes: int = option(1, "processes over which the robots are spread", ge=1, le=256)
    ray: str = option("", "spread the processes over a Ray cluster: its ADDRESS, auto, or local; needs --url")
    latency: Annotated[str, BeforeValidator(str, json_schema_input_type=str | float)] = option(
        "", "how long echo takes to answer: ms, FAMILY:mean_ms=...,key=value, FILE.csv [default: no time]", first=True
    )
    predict: str = option(
        "",
        "predict, in virtual time: the run folder of one robot, or service times as in --latency",
        first=True,
    )
    servers: int = option(1, "--predict: servers that share one queue", ge=1, le=1000)
    batch: Path | None = option(
        None, "--predict: CSV of a batching server, columns batch and latency_ms, that of so many requests together"
    )
    requests: CapacityRequests = group(CapacityRequests, only=(*SHOWN, "max_tokens"), first=("transports", "url"))

    @property
    def virtual(self) -> bool:
        return bool(self.predict)

    @cached_property
    def numbers(self) -> Sequence[int]:
        """The numbers of robots to try, ascending; of FROM..TO the powers of two times FROM, then TO."""
        low, _, high = self.robots.partition("..")
        try:
            found = sorted({int(each) for each in (*low.split(","), *high.split(",")) if each.strip()})
        except ValueError:
            found = []
        if not found or found[0] < 1:
            raise UsageError(f"`robots`: '{self.robots}' should be 1 or more: a number, a list, or FROM..TO")
        if not high:
            return tuple(found)
        first, last = found[0], found[-1]
        return (*(first << step for step in range((last // first).bit_length()) if first << step < last), last)

    @property
    def searches(self) -> bool:
        return ".." in self.robots and self.limited is not None

    @property
    def most_fleets(self) -> int:
        """Return the most fleets of a search, one robot alone included."""
        bisected = math.ceil(math.log2(self.numbers[-1] / self.numbers[0])) if self.searches else 0
        return len({1, *self.numbers}) + bisected

    @property
    def confidence(self) -> float:
        """Return the confidence of one look, so that all looks of a search are right with 95 % (Bonferroni)."""
        return 1 - 0.05 / (self.most_fleets * self.looks)

    @cached_property
    def limited(self) -> Limit | None:
        """The limit; by default none for clients without a clock."""
        if not self.limit or (self.closed_loop and "limit" not in self.model_fields_set):
            return None
        try:
            return Limit.read(self.limit)
        except ValueError as error:
            raise UsageError(f"`limit`: {error}") from error

    def limit_text(self, mode: str) -> str:
        """Return the limit in words, as it is for a mode, or for "" for robots without one."""
        if self.limited is None or self.limited.column != "stalled":
            return "" if self.limited is None else self.limited.text
        beyond = " beyond those of one robot alone" if self.beyond_alone(mode) else ""
        return f"{self.limited.text} {'ticks' if self.load == 'chunks' else 'plans'}{beyond}"

    def beyond_alone(self, mode: str) -> bool:
        """Return True if only stalls beyond those of one robot alone count, as in a mode that blocks."""
        return (
            bool(mode)
            and self.control.modes[mode].blocks
            and self.limited is not None
            and self.limited.column == "stalled"
        )

    @property
    def settle_ns(self) -> int:
        settle_s = self.settle_s if self.settle_s is not None else 0.0 if self.episodes_s else SETTLE_S
        return round(settle_s * 1e9)

    @cached_property
    def load(self) -> Literal["chunks", "plans", "closed"]:
        """What the robots do; those of a transport that carries no actions ask for plans."""
        if self.closed_loop:
            return "closed"
        return "plans" if self.plan_every_s is not None or (not self.predict and self._answer == TOKENS) else "chunks"

    @property
    def plan_ns(self) -> int:
        return round((self.plan_every_s or PLAN_EVERY_S) * 1e9)

    @property
    def _answer(self) -> str:
        able = all(ACTIONS in each.capabilities.answer_kinds for each in self.requests.pipelines)
        return ACTIONS if able and self.plan_every_s is None else TOKENS

    @cached_property
    def live_requests(self) -> LoopRequests:
        """The requests of a measured run; raises UsageError naming the field."""
        return self.requests.of_robots(self._answer, self.latency, self)

    def check(self) -> None:
        """Refuse what makes no sense together; raises UsageError naming the fields."""
        super().check()
        most = MOST_ROBOTS if self.predict else MOST_CONNECTIONS
        if self.numbers[-1] > most:
            raise UsageError(f"`robots`: {self.numbers[-1]} are more than {most}")
        if self.episodes_s and (self.closed_loop or self.episodes_s * self.control_hz < 2):  # noqa: PLR2004
            raise UsageError(f"`episodes`: {self.episodes_s:g} s need a control clock, and two of its ticks")
        if self.episodes_s and self.settle_ns >= self.episodes_s * 1e9:
            raise UsageError(f"`settle`: {self.settle_s:g} s leave nothing of an episode of {self.episodes_s:g} s")
        if self.predict:
            given = {"processes", "ray", "latency"} & self.model_fields_set
            if alone := next(iter((*sorted(given), *self.requests.given())), ""):
                raise UsageError(f"`{alone}` is for a measured run; leave it out with `predict`")
        else:
            self._check_measured()
        self._check_load()

    def _check_measured(self) -> None:
        for name in ("servers", "batch"):
            if name in self.model_fields_set:
                raise UsageError(f"`{name}` needs `predict`")
        _ = self.live_requests
        if several := [name for name, each in self.control.modes.items() if each.several]:
            raise UsageError(
                f"`modes`: {several[0]} has several requests under way, a robot one connection; `predict` it instead"
            )
        if self.ray and not all(each.options.external_address for each in self.requests.pipelines):
            raise UsageError("`ray`: robots on other hosts need a server that they reach; name it with `url`")

    def _check_load(self) -> None:
        limit, given = self.limited, self.model_fields_set
        if "think_s" in given and not self.closed_loop:
            raise UsageError("`think` needs `closed_loop`")
        if "modes" in given and self.load != "chunks":
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
