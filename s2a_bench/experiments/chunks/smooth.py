"""How smoothly a plant moves under a mode, in virtual time: actions are the best forecasts there can be of a target.

Nobody can know far ahead where the robot should be. Virtual time has no pictures and no policy: a stand-in that cannot
be improved leaves timing alone to be measured.
The action of index i in a chunk is meant for i ticks after its observation, and forecasts the target then. Where a mode
executes it later, as queue does, the robot lags.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.stats.seeds import generator

if TYPE_CHECKING:
    from s2a_bench.act import ActionKind
    from s2a_bench.act.plant import PlantMotion
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Cycles, Ints, Mode, Ticks

RATE: Final = 3.0
"""In 1/s: how fast the target changes its mind. What it does in .32 s is known up to .66 standard deviations."""
MOST_TICKS: Final = 50_000
"""Control ticks of a cell whose motion is computed, the first ones."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetPath:
    """A target at control ticks, in units of its standard deviation; arrays of shape (K,).

    Position x and drift y = x' + r x follow dy = -r y dt + noise, dx = (y - r x) dt: a stationary Gaussian process with
    covariance (1 + r |t|) e^(-r |t|), Matern's with parameter 3/2. Its path has a velocity, and no acceleration.
    """

    position: Floats
    drift: Floats
    period_s: float

    def forecast(self, tick: Ints, ahead: Ints) -> Floats:
        """Return E[x(tick + ahead)] given all until ``tick``, arrays of one shape; with ``ahead`` >= 0."""
        time_s = ahead * self.period_s
        expected: Floats = np.exp(-RATE * time_s) * (self.position[tick] + self.drift[tick] * time_s)
        return expected


def draw_target(rng: np.random.Generator, ticks: int, period_s: float) -> TargetPath:
    """Draw a target, exact at its ticks; the first ones are the same however many there are."""
    from scipy.signal import lfilter
    from scipy.special import gammainc

    step = RATE * period_s
    keep = np.exp(-step)
    of_drift, of_both, of_position = gammainc((1, 2, 3), 2 * step)  # what noise adds in a tick to x and y / r
    added = np.linalg.cholesky([[2 * of_drift, of_both], [of_both, of_position]])
    first = np.linalg.cholesky([[2.0, 1.0], [1.0, 1.0]])
    drawn = rng.standard_normal((ticks, 2))
    noise = drawn @ added.T
    noise[:1] = drawn[:1] @ first.T
    drift = lfilter([1.0], [1.0, -keep], noise[:, 0])
    noise[1:, 1] += keep * step * drift[:-1]
    return TargetPath(lfilter([1.0], [1.0, -keep], noise[:, 1]), RATE * drift, period_s)


@dataclass(frozen=True, slots=True, eq=False)
class TrackingPlant:
    """A plant that is to follow a target."""

    plant: ActionKind
    target: TargetPath

    def measure(self, mode: Mode, cycles: Cycles, ticks: Ticks) -> Mapping[str, float]:
        """Return the metrics of smoothness by their names; none where nothing was executed.

        ``..._ideal`` is of the plant alone: with a request in every tick and no latency.
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
        return {**found, **{f"{name}_ideal": ideal[name] for name in ("tracking_rms", "jerk_rms")}}


def follower(config: ChunksConfig) -> TrackingPlant | None:
    """Return what follows, the same target for all cells of a seed; None without a robot.

    Nor where all actions are slowed down: no target waits for them.
    """
    if config.plant is None or config.slow_down > 1:
        return None
    rng = generator(config.seed, "chunks target")
    return TrackingPlant(config.plant, draw_target(rng, MOST_TICKS, config.setting.period_ns / 1e9))


def executed(mode: Mode, cycles: Cycles, ticks: Ticks, target: TargetPath) -> Floats:
    """Return the action of each tick, as long as the target goes; NaN for no action."""
    length = min(ticks.chunk.size, target.position.size)
    found = np.full(length, np.nan)
    for tick, chunk, index, share in mode.blend(cycles, ticks):
        early = tick < length
        at, request_tick = tick[early], cycles.request_tick[chunk[early]]
        found[at] = np.nan_to_num(found[at]) + share[early] * target.forecast(request_tick, index[early])
    return found


def smoothness(motion: PlantMotion, actions: Floats, chunk: Ints, reference: Floats | None = None) -> dict[str, float]:
    """Measure a motion under actions of shape (K, D), of which tick k's is from ``chunk[k]``, -1 in a stall.

    ``reference``, shape (K, D), is where the joints should have been when each tick began; without it there is no
    ``tracking_rms``. Returns metrics by their names, in the actions' unit and s, root mean squares over joints and
    time, NaN where there is nothing to count. Jumps and steps, from one action to the next across a boundary of chunks
    and within a chunk, are Euclidean over joints.
    """
    acted = np.flatnonzero(chunk >= 0)
    step = np.linalg.norm(np.diff(actions[acted], axis=0), axis=1)
    other = np.diff(chunk[acted]) != 0
    jump = step[other]
    found = {
        "jerk_rms": _rms(motion.jerk),
        "boundary_jump_mean": _mean(jump),
        "boundary_jump_p99": float(np.quantile(jump, 0.99)) if jump.size else nan,
        "action_step_mean": _mean(step[~other]),
    }
    return found if reference is None else {"tracking_rms": _rms(motion.position[:, 0] - reference), **found}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else nan
