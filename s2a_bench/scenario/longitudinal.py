"""A bare integrator along the lane, as many roll-outs in lock step as wanted: for phase diagrams and random studies."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from s2a_bench.scenario import STEP_S, Command, State
from s2a_bench.scenario.lockstep import LockStep

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats


class Longitudinal(LockStep):
    """Cars without width or steering; constant acceleration within a step, down to rest."""

    name: ClassVar[str] = "longitudinal"
    steers: ClassVar[bool] = False
    most: ClassVar[int | None] = None

    def __init__(self, step_s: float = STEP_S) -> None:
        self.step_s = step_s
        self._state = State(np.empty((3, 0)), np.empty((3, 0)), np.empty((3, 0)))

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Begin anew."""
        self._state = State(position_m.astype(float), speed_mps.astype(float), np.zeros(position_m.shape))
        return self._state

    def step(self, command: Command) -> State:
        """Integrate by the trapezoidal rule, which is exact until a car comes to rest within the step."""
        before = self._state
        speed = np.maximum(before.speed_mps + command.acceleration_mps2 * self.step_s, 0.0)
        position = before.position_m + (before.speed_mps + speed) * (self.step_s / 2)
        self._state = State(position, speed, before.lateral_m)
        return self._state

    def keep(self, columns: NDArray[np.int64]) -> None:
        """Go on with these roll-outs only."""
        now = self._state
        self._state = State(now.position_m[:, columns], now.speed_mps[:, columns], now.lateral_m[:, columns])

    def close(self) -> None:
        """Hold nothing."""
