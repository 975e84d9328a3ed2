"""How smoothly a plant moves under a mode, in virtual time: actions are the best forecasts there can be of a target.

The action of index i in a chunk is meant for i ticks after its observation, and forecasts the target then. Where a mode
executes it later, as queue does, the robot lags.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments.chunks.rows import SmoothnessRow
from s2a_bench.experiments.chunks.target import Target, draw_target
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.policy.chunks.aggregate import Aggregate
from s2a_bench.robots.smoothness import smoothness

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Drawn
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Cycles, Mode, Ticks
    from s2a_bench.robots.plant import Plant

MOST_TICKS: Final = 50_000
"""Control ticks of a cell whose motion is computed, the first ones."""
REQUESTS: Final = 2000
"""Of each mean latency in the diagram."""


@dataclass(frozen=True, slots=True, eq=False)
class Follower:
    """A plant that is to follow a target."""

    plant: Plant
    target: Target

    def measure(self, mode: Mode, cycles: Cycles, ticks: Ticks) -> Mapping[str, float]:
        """Return the metrics of smoothness by their names; none where nothing was executed.

        ``..._ideal`` is of the plant alone: asked in every tick, and answered at once.
        """
        target, period_s = self.target, self.target.period_s
        chunk = ticks.chunk[: target.position.size]
        if not (chunk >= 0).any():
            return {}
        first = int((chunk >= 0).argmax())
        actions = executed(mode, cycles, ticks, target)[first:, np.newaxis]
        wanted = target.position[first : chunk.size, np.newaxis]
        found = smoothness(self.plant.respond(actions, period_s), actions, chunk[first:], wanted)
        ideal = smoothness(self.plant.respond(wanted, period_s), wanted, chunk[first:], wanted)
        return {
            "tracking_rms": found.tracking_rms,
            "tracking_rms_ideal": ideal.tracking_rms,
            "jerk_rms": found.jerk_rms,
            "jerk_rms_ideal": ideal.jerk_rms,
            "boundary_jump_mean": found.boundary_jump_mean,
            "boundary_jump_p99": found.boundary_jump_p99,
            "action_step_mean": found.action_step_mean,
        }


def follower(config: ChunksConfig) -> Follower | None:
    """Return what follows, the same target for all cells of a seed; None where no robot is asked for.

    Nor where all actions are slowed down: no target waits for them.
    """
    if config.plant is None or config.slow_down > 1:
        return None
    rng = generator(config.seed, "chunks target")
    return Follower(config.plant, draw_target(rng, MOST_TICKS, config.setting.period_ns / 1e9))


def executed(mode: Mode, cycles: Cycles, ticks: Ticks, target: Target) -> Floats:
    """Return the action of each tick, as long as the target goes; NaN for no action."""
    length = min(ticks.chunk.size, target.position.size)
    found = np.full(length, np.nan)
    if isinstance(mode, Aggregate):
        for tick, chunk, index, share in mode.blend(cycles):
            early = tick < length
            at, asked = tick[early], cycles.request_tick[chunk[early]]
            found[at] = np.nan_to_num(found[at]) + share[early] * target.forecast(asked, index[early])
        return found
    acted = np.flatnonzero(ticks.chunk[:length] >= 0)
    found[acted] = target.forecast(cycles.request_tick[ticks.chunk[acted]], ticks.index[acted])
    return found


def smoothness_rows(config: ChunksConfig, drawn: Drawn, follows: Follower | None) -> Iterator[SmoothnessRow]:
    """Try each mode as given over mean latency; none where no robot is asked for, or no diagram."""
    if follows is None or not config.stability:
        return
    setting, shape = config.setting, drawn.judged[:REQUESTS] / max(float(drawn.judged[:REQUESTS].mean()), 1.0)
    for mean_ns in np.linspace(0, setting.horizon * setting.period_ns, config.stability):
        latency_ns = np.rint(shape * mean_ns).astype(np.int64)
        for name, mode in config.made.items():
            found = follows.measure(mode, mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting))
            yield SmoothnessRow(
                latency=drawn.source.name,
                mode=name,
                latency_s=mean_ns / 1e9,
                tracking_rms=found.get("tracking_rms"),
                tracking_rms_ideal=found.get("tracking_rms_ideal"),
                jerk_rms=found.get("jerk_rms"),
                jerk_rms_ideal=found.get("jerk_rms_ideal"),
                boundary_jump_mean=_told(found.get("boundary_jump_mean")),
            )


def _told(value: float | None) -> float | None:
    return None if value is None or np.isnan(value) else value
