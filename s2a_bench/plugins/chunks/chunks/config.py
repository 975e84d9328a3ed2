"""The options of a run of chunks: acting modes and rules under given latencies, or live on a server's answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final

from s2a_bench.act import ROBOTS, ActionKind, TaskKind, kind
from s2a_bench.boards.latency import EXAMPLE
from s2a_bench.boards.profile import profile_files
from s2a_bench.errors import UsageError
from s2a_bench.options import Names, one_of, option
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode
from s2a_bench.plugins.chunks.options import ControlOptions, GivenLatencies, ServedOptions, Sources
from s2a_bench.policy.conformal import GUARANTEE, Guarantee, fewest

LIVE_RULES: Final = ("calibrated", "tracked", "maximum", "mean")
RULES: Final = (*LIVE_RULES, "oracle")
PROMISING: Final = ("calibrated", "tracked")
"""Rules that keep to `epsilon`, given enough latencies."""
CYCLES: Final = 10_000
CALIBRATION: Final = 8_000
MOST_LIVE_TICKS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class RulesPlan:
    """The rules that choose the trigger of ``mode``, each in a cell; None: no mode has a trigger."""

    mode: Mode | None
    tried: Sequence[str]
    epsilon: float
    guarantee: Guarantee
    slowest: float
    """The largest factor by which a rule may slow actions down."""

    @property
    def promise(self) -> bool:
        """Whether one of them keeps to ``epsilon``."""
        return self.mode is not None and not {*PROMISING}.isdisjoint(self.tried)


def rules_option(default: tuple[str, ...]) -> Any:
    about = "further rows for the first queue, its trigger chosen by each; empty text for none"
    return option(default, about if default else f"{about} [default: none]", first=True)


class ChunksOptions(ControlOptions):
    """Modes of acting on chunks, and rules for their triggers."""

    slow_down: float = option(1.0, "all actions so many times slower (time-scaling)", ge=1, le=1000)
    slowest: float = option(
        1.0, "so many times slower calibrated and oracle may make actions where no trigger is enough", ge=1, le=1000
    )
    rules: Annotated[Names, one_of(lambda: LIVE_RULES)] = rules_option(())
    epsilon: float = option(0.01, "share of cycles that may stall, for the rules", flag="eps", gt=0, lt=1)
    guarantee: Guarantee = GUARANTEE
    shown_ticks: int = option(
        120, "control ticks of each row that are drawn, and in virtual time kept", ge=0, le=100_000
    )
    export_delays: Path | None = option(
        None, "also write each request's times, L and d as CSV, for other simulators; of one source of latencies"
    )

    @property
    def setting(self) -> ControlSetting:
        return super().setting.slowed(self.slow_down)

    @property
    def rules_tried(self) -> Sequence[str]:
        return self.rules

    @cached_property
    def rules_plan(self) -> RulesPlan:
        mode = next((each for each in self.control.modes.values() if each.triggered), None)
        return RulesPlan(mode, self.rules_tried, self.epsilon, self.guarantee, self.slowest)

    def check(self) -> None:
        super().check()
        file = self.export_delays
        if file is not None and (file.suffix != ".csv" or not file.parent.is_dir()):
            raise UsageError(f"`export_delays`: {file} should be a .csv file in a folder that there is")

    def to_manifest(self) -> dict[str, Any]:
        return {**super().to_manifest(), "live": not self.virtual}


class ChunksVirtual(ChunksOptions, GivenLatencies):
    """Acting modes and rules under given latencies."""

    control_hz: float = option(50.0, "control ticks a second", ge=1e-3, le=1e6, allow_inf_nan=False)
    latency: Sources = option(
        (EXAMPLE,),
        "observation to usable chunk (with streamed: to its first action): ms, FAMILY:mean_ms=...,key=value, FILE.csv, "
        "a run folder, or a profile; several with commas; live: how long echo takes to answer, ms, FAMILY, FILE.csv",
        first=True,
        names=profile_files,
    )
    rules: Annotated[Names, one_of(lambda: RULES)] = rules_option(RULES)
    cycles: int | None = option(
        None, f"requests of each row [default: {CYCLES}; replayed: as many as there are]", ge=2, le=1_000_000
    )
    calibration_cycles: int = option(
        CALIBRATION, "further requests that the rules learn from; of a recording its first half at most", ge=1
    )

    @property
    def rules_tried(self) -> Sequence[str]:
        """The rules; by default none with too few latencies to learn from."""
        if "rules" in self.model_fields_set:
            return self.rules
        return tuple(rule for rule in self.rules if rule not in PROMISING or not self.too_few)

    @cached_property
    def too_few(self) -> str:
        """The source with too few latencies for a rule that keeps to `epsilon`, as text; else empty."""
        needed = fewest(self.epsilon)
        for source in self.sources:
            if (count := source.learnable(self.calibration_cycles)) < needed:
                return (
                    f"{source.name} has {count} latencies to learn from (of a recording the first half); "
                    f"a stall in {self.epsilon:.2%} of the cycles takes {needed}"
                )
        return ""

    @property
    def learnt(self) -> int:
        """The most latencies of a source that rules learn from."""
        return self.calibration_cycles if self.rules_plan.mode is not None and self.rules_plan.tried else 0

    def check(self) -> None:
        super().check()
        if self.export_delays is not None and len(self.sources) != 1:
            names = ", ".join(source.name for source in self.sources)
            raise UsageError(f"`export_delays`: {len(self.sources)} sources of `latency`, {names}; name one of them")
        for source in self.sources:
            recorded, learnt = source.recorded_ns, source.learnable(self.learnt)
            if recorded is not None and recorded.size - learnt < 2:  # noqa: PLR2004 - a boundary
                kept = f", and `rules` set {learnt} aside" if learnt else ""
                raise UsageError(
                    f"`latency`: {source.name} has {recorded.size} latencies{kept}; two or more are needed"
                )
        if self.rules_plan.promise and self.too_few:
            others = ",".join(rule for rule in RULES if rule not in PROMISING)
            raise UsageError(f"`rules`: {self.too_few}; raise `epsilon`, or take `rules` {others}")


class ChunksLive(ChunksOptions, ServedOptions):
    """Acting modes and rules in real time, on the answers of a server."""

    seconds: float = option(20.0, "how long each mode acts", gt=0, le=86_400)
    robot: str = option(
        "",
        "what takes the actions: ros?topic=/NAME, call?function=MODULE:NAME [default: none]",
        first=True,
        names=lambda: ROBOTS,
    )

    @cached_property
    def robot_kind(self) -> ActionKind | None:
        return kind(self.robot, ActionKind) if self.robot else None

    def check(self) -> None:
        super().check()
        if isinstance(self.robot_kind, TaskKind):
            raise UsageError(f"`robot`: {self.robot.partition('?')[0]} does a task: run 's2a-bench task'")
        if self.seconds * 1e9 < 2 * self.setting.period_ns:
            raise UsageError(
                f"`seconds`: {self.seconds:g} s are less than two ticks at `control_hz` {self.control_hz:g}"
            )
        if self.seconds * self.control_hz > MOST_LIVE_TICKS:
            raise UsageError(
                f"`seconds`: {self.seconds:g} s at `control_hz` {self.control_hz:g} are over {MOST_LIVE_TICKS:.0e} "
                "control ticks, which are held in memory; act for a shorter time"
            )
        if self.rules_plan.promise and self.requests.warmup < (needed := fewest(self.epsilon)):
            raise UsageError(
                f"`warmup`: {self.requests.warmup} requests are too few to learn from for `epsilon` "
                f"{self.epsilon:g}; take {needed} or more, or other `rules`"
            )
        if self.export_delays is not None and len(self.robots_requests.pipelines) > 1:
            raise UsageError("`export_delays`: of one `transport` at a time")

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        if self.robot_kind is not None and (risk := self.robot_kind.risk):
            yield "robot", risk, self.robot
