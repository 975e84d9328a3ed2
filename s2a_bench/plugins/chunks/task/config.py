"""The options of a run of a task: a robot with a world, its policy, and latencies or servers."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

from s2a_bench.act import ROBOTS, TaskKind, kind
from s2a_bench.boards.profile import profile_files
from s2a_bench.errors import UsageError
from s2a_bench.harness.config import AROUND, DEFAULT_TASK, GROUPED
from s2a_bench.inference import EngineConfig, check_engine
from s2a_bench.options import Names, group, option
from s2a_bench.plugins.chunks.modes import ControlSetting, Rounding, mode
from s2a_bench.plugins.chunks.options import (
    ControlOptions,
    GivenLatencies,
    LoopRequests,
    ServedOptions,
    Sources,
    acting_modes,
)

MOST_STEPS = 1_000_000


class TaskOptions(ControlOptions):
    """A robot with a task, under acting modes."""

    robot: str = option(
        ..., "robot with a world, as gym?env=CartPole-v1&success=survival", first=True, names=lambda: ROBOTS
    )
    modes: Names = acting_modes(("sync", "replace?execute=8"))
    control_hz: float | None = option(  # type: ignore[assignment] # None: asked when it runs
        None, "control ticks a second [default: those of the robot's world]", ge=1e-3, le=10_000, allow_inf_nan=False
    )
    rounding: Rounding = option("ceil", "ceil: an action counts from its arrival on; floor: for the whole tick of it")
    episodes: int = option(50, "episodes of each row; all rows have the same seeds", ge=1, le=100_000, first=True)
    steps: int = option(MOST_STEPS, "control ticks after which an episode ends, if it has not", ge=1, le=MOST_STEPS)
    margin: float = option(0.1, "share of successes that a latency may cost, to be borne", gt=0, lt=1)

    @cached_property
    def robot_kind(self) -> TaskKind:
        return kind(self.robot, TaskKind)

    @property
    def setting(self) -> ControlSetting:
        """The control period: asks the robot's world unless `control_hz` is given; raises S2AError."""
        period_ns = round(1e9 / self.control_hz) if self.control_hz else self.robot_kind.period_ns
        return ControlSetting(period_ns, self.horizon, self.rounding)

    def check_modes(self) -> None:
        _ = [mode(each) for each in self.modes]  # their control period is the world's, which only a run opens

    def check(self) -> None:
        super().check()
        _ = self.robot_kind  # raises UsageError

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        if risk := self.robot_kind.risk:
            yield "robot", risk, self.robot

    def to_manifest(self) -> dict[str, Any]:
        return {**super().to_manifest(), "live": not self.virtual}


class TaskVirtual(TaskOptions, GivenLatencies):
    """Acting modes under given latencies; the policy is asked in this process."""

    engine: EngineConfig = group(EngineConfig, only=("name", "action_dim"))
    prompt: str = option(DEFAULT_TASK, "the task in words")
    latency: Sources = option(
        ("0", "50", "100", "200"),
        "observation to usable chunk: ms, FAMILY:mean_ms=...,key=value, FILE.csv, a run folder, or a profile; several "
        "with commas; 0 is what the others are judged by; live: how long echo takes to answer",
        first=True,
        names=profile_files,
    )

    @cached_property
    def policy(self) -> EngineConfig:
        return self.engine.but(answer="actions", horizon=self.horizon)

    def check(self) -> None:
        super().check()
        if "name" not in self.engine.model_fields_set:
            raise UsageError("`engine`: name the policy, as call?function=MODULE:NAME")
        check_engine(self.policy)
        _ = self.sources  # raises UsageError


class TaskLive(TaskOptions, ServedOptions):
    """Acting modes in real time, on the answers of a server."""

    requests: LoopRequests = group(LoopRequests, only=(*GROUPED, *AROUND, "prompt"), first=("transports",))
