"""The simulator `toy-world`: cars whose brakes act late, on a server whose settings it changes while it is open."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from s2a_bench.frames import FrameSource
from s2a_bench.policy import Floats
from s2a_bench.scenario import STEP_S, DriveCommand, Simulator, State
from s2a_bench.scenario.windscreen import Windscreen

SERVER = {"synchronous": False}
"""The settings of what stands for a simulator's server, which outlives its clients."""
LAG_S = 0.04


class ToyWorld(Simulator):
    """One lane; an acceleration comes after a lag of first order."""

    name: ClassVar[str] = "toy-world"
    real: ClassVar[bool] = True
    steers: ClassVar[bool] = False
    most: ClassVar[int | None] = 1
    over_ros: ClassVar[bool] = False

    step_s = STEP_S

    def __init__(self) -> None:
        """Take the server."""
        self._before = dict(SERVER)
        SERVER["synchronous"] = True
        self._acceleration = np.empty((3, 0))
        self._state = State(self._acceleration, self._acceleration, self._acceleration)

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Begin anew."""
        self._acceleration = np.zeros_like(position_m)
        self._state = State(position_m.copy(), speed_mps.copy(), np.zeros_like(position_m))
        return self._state

    def step(self, command: DriveCommand) -> State:
        """Follow the command late."""
        before, share = self._state, self.step_s / LAG_S
        self._acceleration = self._acceleration + (command.acceleration_mps2 - self._acceleration) * share
        speed = np.maximum(before.speed_mps + self._acceleration * self.step_s, 0.0)
        self._state = State(before.position_m + speed * self.step_s, speed, before.lateral_m)
        return self._state

    def camera(self, width: int, height: int) -> FrameSource:
        """See what every simulator's cars see; one with pictures of its own has a source of its own."""
        return Windscreen(lambda: (self._state, self._acceleration), width, height)

    def close(self) -> None:
        """Give the server back as it was."""
        SERVER.update(self._before)
