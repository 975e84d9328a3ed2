"""The embedded simulator: highway-env's kinematic bicycles on a straight road, driven by our accelerations.

highway-env integrates with explicit Euler steps and steers by its own lane controller. Pictures: `ccrb.render`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np

from s2a_bench import extras
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LEAD, REAR, STEP_S, DriveCommand, State

ROAD_M: Final = 5000.0
BEHIND_M: Final = 500.0
LANE_WIDTH_M: Final = 4.0
LANES: Final = {0: 1, 1: 0}
"""Our lane, 0 where all start and 1 to its left -> highway-env's, which counts from the left."""
MIDDLE_M: Final = LANE_WIDTH_M * LANES[0]
"""Where our lane's middle lies on highway-env's y axis, which points to the right."""
LENGTHS: Final = {LEAD: 1.0, EGO: 0.0, REAR: -1.0}
"""By how many car lengths a centre lies ahead of our positions, which are bumper to bumper."""


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

    def step(self, command: DriveCommand) -> State:
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
        self._cars = {}

    def _state(self) -> State:
        position = [[vehicle.position[0] - LENGTHS[car] * vehicle.LENGTH] for car, vehicle in self._cars.items()]
        speed = [[vehicle.speed] for vehicle in self._cars.values()]
        lateral = [[MIDDLE_M - vehicle.position[1]] for vehicle in self._cars.values()]
        return State(np.array(position), np.array(speed), np.array(lateral))


def build_road() -> Any:
    """Make the road; raises MissingExtra without highway-env."""
    made_of = extras.require("highway_env.road.road", "ccrb")
    straight = made_of.RoadNetwork.straight_road_network
    network = straight(len(LANES), start=-BEHIND_M, length=ROAD_M + BEHIND_M, speed_limit=50.0)
    # A fixed source of randomness: nothing on this road draws from it, but without one it would be seeded anew.
    return made_of.Road(network, np_random=np.random.RandomState(0), record_history=False)


def centre(car: int, position_m: float, lateral_m: float, length_m: float) -> Floats:
    """Return highway-env's coordinates of a car, in m."""
    return np.array([position_m + LENGTHS[car] * length_m, MIDDLE_M - lateral_m])


def lane_index(lane: int) -> tuple[str, str, int]:
    """Return highway-env's name of a lane."""
    return ("0", "1", LANES[lane])
