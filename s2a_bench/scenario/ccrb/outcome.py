"""Outcomes of the three cars: impacts, gaps, times to collision, watched step by step."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LEAD, REAR, State
from s2a_bench.scenario.ccrb.cars import CAR_WIDTH_M, LEAST_IMPACT_MPS, OUTCOMES
from s2a_bench.scenario.longitudinal import LockStep


@dataclass(frozen=True, slots=True)
class Outcomes:
    """M roll-outs, arrays of shape (M,). Undefined values are NaN; a gap with an impact is 0."""

    code: NDArray[np.int64]
    """Bit 0: the ego hit the lead; bit 1: it was hit from behind."""
    front_impact_mps: Floats
    rear_impact_mps: Floats
    """Difference of speeds at the impact."""
    min_front_gap_m: Floats
    min_rear_gap_m: Floats
    min_front_ttc_s: Floats
    min_rear_ttc_s: Floats
    """Least gap over closing speed; 0 with an impact, NaN if the gap never shrank."""
    required_decel_mps2: Floats
    """Greatest closing speed^2 / (2 gap) to the lead (DRAC); NaN with a front impact."""

    def put(self, rollouts: NDArray[np.int64], latest: Outcomes) -> None:
        for item in fields(self):
            getattr(self, item.name)[rollouts] = getattr(latest, item.name)

    def name(self, rollout: int) -> str:
        return OUTCOMES[int(self.code[rollout])]

    @property
    def impact_speed_mps(self) -> Floats:
        return np.fmax(self.front_impact_mps, self.rear_impact_mps)


class CarPair(LockStep):
    """Watches two cars, one behind the other, until they crash."""

    def __init__(self, ahead: int, behind: int, state: State) -> None:
        self._ahead, self._behind = ahead, behind
        self.gap_m, self._closing = self._look(state)
        self.crashed = np.zeros(self.gap_m.shape, bool)
        self.impact_mps = np.full(self.gap_m.shape, np.nan)
        self.least_m = self.gap_m.copy()
        self.least_ttc_s = np.full(self.gap_m.shape, np.inf)
        self.drac = np.zeros(self.gap_m.shape)

    def watch(self, state: State, live: NDArray[np.bool_]) -> None:
        gap, closing = self._look(state)
        beside = np.abs(state.lateral_m[self._ahead] - state.lateral_m[self._behind]) >= CAR_WIDTH_M
        counts = live & ~self.crashed & ~beside
        touching = counts & (gap <= 0)
        if touching.any():
            share = np.divide(self.gap_m, self.gap_m - gap, out=np.ones(gap.shape), where=self.gap_m > gap)
            speed = self._closing + np.clip(share, 0.0, 1.0) * (closing - self._closing)
            crash = touching & (speed > LEAST_IMPACT_MPS)
            self.impact_mps[crash] = speed[crash]
            self.crashed |= crash
        self.least_m = np.where(counts, np.minimum(self.least_m, gap), self.least_m)
        near = counts & (closing > 0) & (gap > 0)
        speed = np.where(near, closing, 1.0)
        self.least_ttc_s = np.where(near, np.minimum(self.least_ttc_s, gap / speed), self.least_ttc_s)
        self.drac = np.where(near, np.maximum(self.drac, speed * speed / (2 * np.where(near, gap, 1.0))), self.drac)
        self.gap_m, self._closing = gap, closing

    def _look(self, state: State) -> tuple[Floats, Floats]:
        ahead, behind = self._ahead, self._behind
        return state.position_m[ahead] - state.position_m[behind], state.speed_mps[behind] - state.speed_mps[ahead]


class CollisionWatch(LockStep):
    """Watches both pairs.

    A front impact ends a roll-out: the motion after a crash is not modelled. After a rear impact the trailing car is
    ignored, and the ego drives on without a push; *both* means that it hits the lead later.
    """

    def __init__(self, state: State) -> None:
        self.front, self.rear = CarPair(LEAD, EGO, state), CarPair(EGO, REAR, state)

    def see(self, state: State) -> None:
        live = ~self.front.crashed
        self.front.watch(state, live)
        self.rear.watch(state, live)

    def outcomes(self) -> Outcomes:
        return Outcomes(
            code=self.front.crashed.astype(np.int64) + 2 * self.rear.crashed,
            front_impact_mps=self.front.impact_mps,
            rear_impact_mps=self.rear.impact_mps,
            min_front_gap_m=np.maximum(self.front.least_m, 0.0),
            min_rear_gap_m=np.maximum(self.rear.least_m, 0.0),
            min_front_ttc_s=_ttc(self.front),
            min_rear_ttc_s=_ttc(self.rear),
            required_decel_mps2=np.where(self.front.crashed, np.nan, self.front.drac),
        )


def _ttc(pair: CarPair) -> Floats:
    least = np.where(np.isfinite(pair.least_ttc_s), pair.least_ttc_s, np.nan)
    return np.where(pair.crashed, 0.0, least)
