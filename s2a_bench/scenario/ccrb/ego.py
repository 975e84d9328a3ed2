"""The ego's control: it follows the set-points of the running skill, and the gap behaviour between skills.

A speed loop of 0.3 s around the set-point, which falls linearly within a skill, with that slope as feed-forward; then
limits of jerk and acceleration. Before the first skill, and after a plan that did not stop it, the ego keeps its speed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.plan.skillset import Gap
from s2a_bench.policy import Floats, Schedule
from s2a_bench.scenario.ccrb.cars import EGO_LEAST_MPS2, Cars, DrivingPlan
from s2a_bench.scenario.ccrb.follower import needed
from s2a_bench.scenario.longitudinal import LockStep

WAITING, ACTING, GAP, DONE = 0, 1, 2, 3
PHASES: Final = ("waiting", "acting", "gap", "done")
MOST_MPS2, STOP_MPS2, JERK_MPS3, LOOP_S = 2.0, 8.0, 30.0, 0.3
"""Most acceleration, deceleration of the gap behaviour *stop*, limit of the jerk, time constant of the speed loop."""
REFLEX_MPS2, REFLEX_TTC_S = 4.0, 1.5
"""The reflex brakes fully above this required deceleration, or below this time to collision."""

BETWEEN: dict[Gap, Callable[[Floats, Floats, Floats], Floats]] = {
    "stop": lambda speed, _slope, _first: np.full(speed.shape, -STOP_MPS2),
    "coast": lambda speed, _slope, _first: np.zeros(speed.shape),
    "hold": lambda _speed, slope, _first: slope,
    "cruise": lambda speed, _slope, first: (first - speed) / LOOP_S,
}
"""Gap behaviour -> acceleration, a function of speed, the last skill's slope, and v0."""


class Ego(LockStep):
    """The ego of M roll-outs, with one schedule each."""

    def __init__(self, cars: Cars, plan: DrivingPlan, schedule: Schedule, rollouts: int) -> None:
        gaps = np.broadcast_to(np.asarray(cars.gap), (rollouts,))
        shape = (len(plan.lane), rollouts)
        self._start_s = np.broadcast_to(np.asarray(schedule.start_s, float), shape)
        self._duration_s = np.broadcast_to(np.asarray(schedule.duration_s, float), shape)
        self._points = np.broadcast_to(plan.set_point_mps, (shape[0] + 1, rollouts))
        self._lanes = (0, *plan.lane)
        self._gaps = gaps
        self._between = {gap: BETWEEN[gap] for gap in set(gaps.tolist())}
        self._reflex, self._braking = cars.reflex, np.zeros(rollouts, bool)
        self.index = np.full(rollouts, -1)  # the current or last skill
        self._next_s = self._start_s[0].copy()
        self._from_s, self._until_s = np.zeros(rollouts), np.full(rollouts, -np.inf)
        self._level, self._slope = self._points[0].copy(), np.zeros(rollouts)
        self.phase = np.full(rollouts, WAITING)
        self.acceleration_mps2 = np.zeros(rollouts)
        self.lag_mps = np.zeros(rollouts)
        """Set-point minus speed; of interest while a skill runs."""
        self.end_s = self._start_s[-1] + self._duration_s[-1]

    @property
    def lane(self) -> NDArray[np.int64]:
        return np.take(self._lanes, self.index + 1)

    def decide(
        self, now_s: float, speed: Floats, gap_m: Floats, lead_mps: Floats, lead_decel: Floats, step_s: float
    ) -> Floats:
        """Return the ego's acceleration in m/s^2 for the next step, shape (M,)."""
        self._advance(now_s)
        self.lag_mps = self._level + self._slope * (now_s - self._from_s) - speed
        wish = np.where(self.phase == ACTING, self._slope + self.lag_mps / LOOP_S, 0.0)
        between = self.phase == GAP
        if between.any():
            for gap, rule in self._between.items():
                wanted = rule(speed, self._slope, self._points[0])
                wish = np.where(between & (self._gaps == gap), wanted, wish)
        wish = np.clip(wish, EGO_LEAST_MPS2, MOST_MPS2)
        if self._reflex:  # full braking near contact, until the ego is no faster than the lead
            closing = speed - lead_mps
            alarm = (needed(speed, gap_m, lead_mps, lead_decel) > REFLEX_MPS2) | (gap_m < closing * REFLEX_TTC_S)
            self._braking = (self._braking | alarm) & (closing > 0)
            wish = np.where(self._braking, EGO_LEAST_MPS2, wish)
        most = JERK_MPS3 * step_s
        self.acceleration_mps2 = self.acceleration_mps2 + np.clip(wish - self.acceleration_mps2, -most, most)
        return self.acceleration_mps2

    def stopped(self, speed: Floats) -> None:
        """Release the brake of cars at rest."""
        self.acceleration_mps2 = np.where((speed <= 0) & (self.acceleration_mps2 < 0), 0.0, self.acceleration_mps2)

    def _advance(self, now_s: float) -> None:
        now_s += 1e-12
        while (due := now_s >= self._next_s).any():
            columns = np.flatnonzero(due)
            index = self.index[columns] + 1
            self.index[columns] = index
            duration = self._duration_s[index, columns]
            self._from_s[columns] = self._start_s[index, columns]
            self._until_s[columns] = self._from_s[columns] + duration
            self._level[columns] = self._points[index, columns]
            change = self._points[index + 1, columns] - self._level[columns]
            self._slope[columns] = np.divide(change, duration, out=np.zeros(change.shape), where=duration > 0)
            last = index == len(self._start_s) - 1
            self._next_s[columns] = np.where(
                last, np.inf, self._start_s[np.minimum(index + 1, len(self._start_s) - 1), columns]
            )
        after = np.where(self.index == len(self._start_s) - 1, DONE, GAP)
        running = np.where(now_s < self._until_s, ACTING, after)
        self.phase = np.where(self.index < 0, WAITING, running)
