"""The embedded simulator: highway-env's kinematic bicycles on its road, driven by our accelerations.

highway-env integrates with explicit Euler steps and steers by its own lane controller. Pictures: `ccrb.render`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from s2a_bench import extras
from s2a_bench.scenario import EGO, LEAD, REAR, STEP_S, Command, State
from s2a_bench.scenario.roads import LENGTHS, MIDDLE_M, build_road, centre, lane_index

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


class Embedded:
    """One road with three vehicles."""

    name: ClassVar[str] = "embedded"
    steers: ClassVar[bool] = True
    most: ClassVar[int | None] = 1

    def __init__(self, step_s: float = STEP_S) -> None:
        extras.need("ccrb", "highway_env")
        self.step_s = step_s
        self._cars: dict[int, Any] = {}

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Begin anew on an empty road."""
        controlled = extras.require("highway_env.vehicle.controller", "ccrb").ControlledVehicle
        free = extras.require("highway_env.vehicle.kinematics", "ccrb").Vehicle
        road = build_road()
        self._cars = {}
        for car in (LEAD, EGO, REAR):
            kind = controlled if car == EGO else free
            at = centre(car, float(position_m[car, 0]), 0.0, free.LENGTH)
            self._cars[car] = kind(road, at, heading=0.0, speed=float(speed_mps[car, 0]))
            road.vehicles.append(self._cars[car])
        return self._state()

    def step(self, command: Command) -> State:
        """Let each vehicle act and step; the ego steers for its lane."""
        for car, vehicle in self._cars.items():
            # A car that would come to rest within the step just does, and none goes backwards.
            least = -vehicle.speed / self.step_s
            acceleration = max(float(command.acceleration_mps2[car, 0]), least)
            steering = vehicle.steering_control(lane_index(int(command.lane[0]))) if car == EGO else 0.0
            # Vehicle's own act: ControlledVehicle's would overwrite what we want.
            vehicle.action = {"steering": steering, "acceleration": acceleration}
            vehicle.step(self.step_s)
            vehicle.speed = max(vehicle.speed, 0.0)
        return self._state()

    def close(self) -> None:
        """Forget the road."""
        self._cars = {}

    def _state(self) -> State:
        """Read the vehicles."""
        cars = [self._cars[car] for car in (LEAD, EGO, REAR)]
        position = [[vehicle.position[0] - LENGTHS[car] * vehicle.LENGTH] for car, vehicle in enumerate(cars)]
        speed = [[vehicle.speed] for vehicle in cars]
        lateral = [[MIDDLE_M - vehicle.position[1]] for vehicle in cars]
        return State(np.array(position), np.array(speed), np.array(lateral))
