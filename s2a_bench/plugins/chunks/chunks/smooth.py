"""The smoothness of a plant under a mode in virtual time: actions are the best possible forecasts of a target.

Virtual time has no pictures and no policy; with optimal forecasts only timing is measured. Action i of a chunk
forecasts the target i ticks after its observation. A mode that executes it later, such as queue, makes the robot lag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.plugins.chunks.modes.metrics import mean, p99
from s2a_bench.stats.seeds import generator

if TYPE_CHECKING:
    from s2a_bench.act import ActionKind, Motion
    from s2a_bench.plugins.chunks.modes import Cycles, Ints, Mode, Ticks
    from s2a_bench.plugins.chunks.options import ControlPlan
    from s2a_bench.policy import Floats

RATE: Final = 3.0
"""In 1/s: how fast the target changes. Its position in 0.32 s is known to within 0.66 standard deviations."""
MOST_TICKS: Final = 50_000
"""The first control ticks of a cell, whose motion is computed."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetPath:
    """A target at control ticks, in units of its standard deviation; arrays of shape (K,).

    Position x and drift y = x' + r x follow dy = -r y dt + noise, dx = (y - r x) dt: a stationary Gaussian process with
    covariance (1 + r |t|) e^(-r |t|) (Matern 3/2). Its path has a velocity, and no acceleration.
    """

    position: Floats
    drift: Floats
    period_s: float

    def forecast(self, tick: Ints, ahead: Ints) -> Floats:
        """Return E[x(tick + ahead)] given the path until ``tick``; arrays of one shape, ``ahead`` >= 0."""
        time_s = ahead * self.period_s
        expected: Floats = np.exp(-RATE * time_s) * (self.position[tick] + self.drift[tick] * time_s)
        return expected


def draw_target(rng: np.random.Generator, ticks: int, period_s: float) -> TargetPath:
    """Draw a target, exact at its ticks; a longer draw begins with the same ticks."""
    from scipy.signal import lfilter
    from scipy.special import gammainc

    step = RATE * period_s
    keep = np.exp(-step)
    of_drift, of_both, of_position = gammainc((1, 2, 3), 2 * step)  # variances that noise adds to y / r and x in a tick
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
    """A plant and the target that it follows."""

    plant: ActionKind
    target: TargetPath

    def measure(self, mode: Mode, cycles: Cycles, ticks: Ticks) -> Mapping[str, float]:
        """Return the metrics of smoothness by name; none if nothing was executed.

        ``..._ideal`` has a request in every tick and no latency.
        """
        target, period_s = self.target, self.target.period_s
        chunk = ticks.chunk[: target.position.size]
        if not (chunk >= 0).any():
            return {}
        first = int((chunk >= 0).argmax())
        actions = executed(mode, cycles, ticks, target)[first:, np.newaxis]
        wanted = target.position[first : chunk.size, np.newaxis]
        metrics = smoothness(self.plant.respond(actions, period_s), actions, chunk[first:], wanted)
        ideal = smoothness(self.plant.respond(wanted, period_s), wanted, chunk[first:], wanted)
        return metrics | {f"{name}_ideal": ideal[name] for name in ("tracking_rms", "jerk_rms")}


def follower(plant: ActionKind, control: ControlPlan) -> TrackingPlant:
    """Return a plant and its target, which all cells of a seed share."""
    rng = generator(control.seed, "chunks target")
    return TrackingPlant(plant, draw_target(rng, MOST_TICKS, control.setting.period_ns / 1e9))


def executed(mode: Mode, cycles: Cycles, ticks: Ticks, target: TargetPath) -> Floats:
    """Return the action of each tick of the target; NaN without an action."""
    length = min(ticks.chunk.size, target.position.size)
    actions = np.full(length, np.nan)
    for tick, chunk, index, share in mode.blend(cycles, ticks):
        early = tick < length
        at, request_tick = tick[early], cycles.request_tick[chunk[early]]
        actions[at] = np.nan_to_num(actions[at]) + share[early] * target.forecast(request_tick, index[early])
    return actions


def smoothness(motion: Motion, actions: Floats, chunk: Ints, reference: Floats | None = None) -> dict[str, float]:
    """Measure a motion under actions of shape (K, D); tick k's action is from ``chunk[k]``, -1 in a stall.

    ``reference``, shape (K, D), holds the wanted positions at the start of each tick; without it there is no
    ``tracking_rms``. Returns metrics by name in the actions' unit and s: root mean squares over joints and time, and
    Euclidean distances from one action to the next across a boundary of chunks (jump) and within a chunk (step); NaN
    without values.
    """
    acted = np.flatnonzero(chunk >= 0)
    step = np.linalg.norm(np.diff(actions[acted], axis=0), axis=1)
    other = np.diff(chunk[acted]) != 0
    jump = step[other]
    metrics = {
        "jerk_rms": _rms(motion.jerk),
        "boundary_jump_mean": mean(jump),
        "boundary_jump_p99": p99(jump),
        "action_step_mean": mean(step[~other]),
    }
    return metrics if reference is None else {"tracking_rms": _rms(motion.position[:, 0] - reference), **metrics}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
