"""M roll-outs in lock step: their state, and a bare integrator along the lane, for phase diagrams and studies."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2a_bench.policy import Floats
from s2a_bench.scenario import DriveCommand, Simulator, State
from s2a_bench.scenario.windscreen import Windscreen


class LockStep:
    """An object with state: every array has the roll-outs along its last axis, from which decided ones are dropped."""

    def keep(self, columns: NDArray[np.int64]) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, value[..., columns])
            elif isinstance(value, LockStep):
                value.keep(columns)
            elif isinstance(value, State):
                setattr(self, name, value.keep(columns))


def each(number: ArrayLike, rollouts: int) -> Floats:
    """Broadcast one number, or M of them, to M roll-outs, shape (M,)."""
    return np.broadcast_to(np.asarray(number, dtype=np.float64), (rollouts,))


class Longitudinal(LockStep, Simulator):
    """Cars without width or steering; constant acceleration within a step, down to rest."""

    name: ClassVar[str] = "longitudinal"
    real: ClassVar[bool] = False
    steers: ClassVar[bool] = False

    def __init__(self) -> None:
        self._acceleration = np.empty((3, 0))
        self._state = State(self._acceleration, self._acceleration, self._acceleration)

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        self._state = State(position_m.astype(float), speed_mps.astype(float), np.zeros(position_m.shape))
        self._acceleration = np.zeros(position_m.shape)
        return self._state

    def step(self, command: DriveCommand) -> State:
        """Integrate by the trapezoidal rule, which is exact until a car comes to rest within the step."""
        before, self._acceleration = self._state, command.acceleration_mps2
        speed = np.maximum(before.speed_mps + command.acceleration_mps2 * self.step_s, 0.0)
        position = before.position_m + (before.speed_mps + speed) * (self.step_s / 2)
        self._state = State(position, speed, before.lateral_m)
        return self._state

    def camera(self, width: int, height: int) -> Windscreen:
        return Windscreen(lambda: (self._state, self._acceleration), width, height)
