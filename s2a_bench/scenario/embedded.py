"""The embedded simulator: highway-env's kinematic bicycles on a straight road, driven by accelerations; Euler steps."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np

from s2a_bench import extras
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LANE_WIDTH_M, LEAD, REAR, DriveCommand, Simulator, State
from s2a_bench.scenario.windscreen import Windscreen

ROAD_M: Final = 5000.0
BEHIND_M: Final = 500.0
LANES: Final = {0: 1, 1: 0}
"""Lane of `DriveCommand` -> lane of highway-env, which counts from the left."""
MIDDLE_M: Final = LANE_WIDTH_M * LANES[0]
"""Middle of the starting lane on highway-env's y axis, which points to the right."""
LENGTHS: Final = {LEAD: 1.0, EGO: 0.0, REAR: -1.0}
"""Car lengths from a position, which is bumper to bumper, to the car's centre."""


class Embedded(Simulator):
    name: ClassVar[str] = "embedded"
    real: ClassVar[bool] = False
    steers: ClassVar[bool] = True
    most: ClassVar[int | None] = 1

    def __init__(self) -> None:
        extras.need("ccrb", "highway_env")
        self._cars: dict[int, Any] = {}
        nothing = np.zeros((3, 1))
        self._shown = (State(nothing, nothing, nothing), nothing)

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        controlled = extras.require("highway_env.vehicle.controller", "ccrb").ControlledVehicle
        free = extras.require("highway_env.vehicle.kinematics", "ccrb").Vehicle
        roads = extras.require("highway_env.road.road", "ccrb")
        straight = roads.RoadNetwork.straight_road_network
        network = straight(len(LANES), start=-BEHIND_M, length=ROAD_M + BEHIND_M, speed_limit=50.0)
        # Fixed and unused; without it highway-env creates a randomly seeded one.
        road = roads.Road(network, np_random=np.random.RandomState(0), record_history=False)
        self._cars = {}
        for car in (LEAD, EGO, REAR):
            kind = controlled if car == EGO else free
            at = np.array([float(position_m[car, 0]) + LENGTHS[car] * free.LENGTH, MIDDLE_M])
            self._cars[car] = kind(road, at, heading=0.0, speed=float(speed_mps[car, 0]))
            road.vehicles.append(self._cars[car])
        return self._state(np.zeros((3, 1)))

    def step(self, command: DriveCommand) -> State:
        for car, vehicle in self._cars.items():
            # A car may come to rest within the step, but not go backwards.
            least = -vehicle.speed / self.step_s
            acceleration = max(float(command.acceleration_mps2[car, 0]), least)
            steering = vehicle.steering_control(("0", "1", LANES[int(command.lane[0])])) if car == EGO else 0.0
            # As Vehicle.act does: ControlledVehicle.act would overwrite the command.
            vehicle.action = {"steering": steering, "acceleration": acceleration}
            vehicle.step(self.step_s)
            vehicle.speed = max(vehicle.speed, 0.0)
        return self._state(command.acceleration_mps2)

    def camera(self, width: int, height: int) -> Windscreen:
        return Windscreen(lambda: self._shown, width, height)

    def _state(self, acceleration_mps2: Floats) -> State:
        position = [[vehicle.position[0] - LENGTHS[car] * vehicle.LENGTH] for car, vehicle in self._cars.items()]
        speed = [[vehicle.speed] for vehicle in self._cars.values()]
        lateral = [[MIDDLE_M - vehicle.position[1]] for vehicle in self._cars.values()]
        state = State(np.array(position), np.array(speed), np.array(lateral))
        self._shown = (state, acceleration_mps2)  # whole, for a camera that another thread reads
        return state
