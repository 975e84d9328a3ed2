"""CARLA as a simulator: three cars on a straight stretch of its map, in synchronous mode.

**This adapter has never been run against a CARLA server**: none is available where the project is built. It is thin,
written to the client API of 0.9.16 (extra ``carla``), and tested against a stand-in of that API. Each step sets the
cars' target velocities, which CARLA's physics follow; positions are read back from the server. Only the embedded
simulator changes lanes. The server's settings are restored at the end.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np

from s2a_bench import extras
from s2a_bench.errors import SimulatorError, UsageError
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LEAD, REAR, ROLES, DriveCommand, State

STEP_S: Final = 0.02
"""CARLA requires at most 0.1 s; a finer step makes roll-outs longer."""
TIMEOUT_S: Final = 10.0
STRAIGHT_M: Final = 250.0
LOOK_M: Final = 10.0
MOST_TURN_DEG: Final = 1.0
SETTLE_TICKS: Final = 50
"""Cars are spawned `DROP_M` above the road."""
LONGEST_M: Final = 10.0
"""Upper limit of a car's length."""
DROP_M: Final = 0.5
BLUEPRINT: Final = "vehicle.tesla.model3"


class Carla:
    """A CARLA server's world, used exclusively."""

    name: ClassVar[str] = "carla"
    steers: ClassVar[bool] = False
    most: ClassVar[int | None] = 1

    def __init__(self, host: str = "localhost:2000", step_s: float = STEP_S, timeout_s: float = TIMEOUT_S) -> None:
        self.step_s = step_s
        self._cars: dict[int, Any] = {}
        self._speed = np.zeros(3)
        carla = self._carla = extras.require("carla", "carla")
        name, _, port = host.partition(":")
        if port and not port.isdecimal():
            raise UsageError(f"`host`: '{host}' should be HOST or HOST:PORT")
        try:
            client = carla.Client(name, int(port or 2000))
            client.set_timeout(timeout_s)
            self._world: Any = client.get_world()
            self._before: Any = self._world.get_settings()
            settings = self._world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = True, step_s
            self._world.apply_settings(settings)
        except RuntimeError as error:
            raise SimulatorError(
                f"`host` {host}: no CARLA server answers ({error}); start one, as ./CarlaUE4.sh -RenderOffScreen"
            ) from error

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        self._remove_cars()
        start = self._straight()
        self._along, self._right = start.transform.get_forward_vector(), start.transform.get_right_vector()
        # The ego first: the other places depend on a car's length.
        behind_m = float(position_m[EGO, 0] - position_m[REAR, 0]) + LONGEST_M
        self._cars = {EGO: self._spawn(EGO, start, behind_m)}
        self._length_m = 2 * float(self._cars[EGO].bounding_box.extent.x)
        for car, lengths in ((LEAD, 1), (REAR, -1)):
            away_m = float(position_m[car, 0] - position_m[EGO, 0]) + lengths * self._length_m
            self._cars[car] = self._spawn(car, start, behind_m + away_m)
        self._speed = np.zeros(3)
        for _ in range(SETTLE_TICKS):
            self._tick()
        self._speed = speed_mps[:, 0].astype(float)
        self._tick()  # the cars start together: gaps stay
        self._origin: Any = self._cars[EGO].get_location()
        self._offset_m = float(position_m[EGO, 0])
        return self._state()

    def step(self, command: DriveCommand) -> State:
        self._speed = np.maximum(self._speed + command.acceleration_mps2[:, 0] * self.step_s, 0.0)
        self._tick()
        return self._state()

    def close(self) -> None:
        self._remove_cars()
        if self._before is not None:
            self._world.apply_settings(self._before)
            self._before = None

    def _tick(self) -> None:
        for car, actor in self._cars.items():
            speed = float(self._speed[car])
            along = actor.get_transform().get_forward_vector()
            actor.set_target_velocity(self._carla.Vector3D(along.x * speed, along.y * speed, actor.get_velocity().z))
        try:
            self._world.tick()
        except RuntimeError as error:
            raise SimulatorError(f"CARLA: the server has disconnected ({error}); start it again") from error

    def _state(self) -> State:
        position, lateral, speed = np.zeros((3, 1)), np.zeros((3, 1)), np.zeros((3, 1))
        for car, actor in self._cars.items():
            at, velocity = actor.get_location(), actor.get_velocity()
            # From centre to centre, a car's length more than from bumper to bumper.
            shift = {LEAD: -self._length_m, EGO: 0.0, REAR: self._length_m}[car]
            position[car] = _dot(at, self._origin, self._along) + shift + self._offset_m
            lateral[car] = -_dot(at, self._origin, self._right)
            speed[car] = max(velocity.x * self._along.x + velocity.y * self._along.y, 0.0)
        return State(position, speed, lateral)

    def _spawn(self, car: int, start: Any, ahead_m: float) -> Any:
        blueprint = self._world.get_blueprint_library().find(BLUEPRINT)
        blueprint.set_attribute("role_name", ROLES[car])
        place = start.next(ahead_m)[0].transform
        place.location.z += DROP_M
        actor = self._world.try_spawn_actor(blueprint, place)
        if actor is None:
            raise SimulatorError(f"CARLA: there is no space to spawn the {ROLES[car]} car; reload the map")
        return actor

    def _straight(self) -> Any:
        world_map = self._world.get_map()
        for spawn in world_map.get_spawn_points():
            first = world_map.get_waypoint(spawn.location)
            last = first
            for _ in range(int(STRAIGHT_M / LOOK_M)):
                ahead = last.next(LOOK_M)
                turn = ahead and ahead[0].transform.rotation.yaw - first.transform.rotation.yaw
                if not ahead or abs((turn + 180) % 360 - 180) > MOST_TURN_DEG:
                    break
                last = ahead[0]
            else:
                return first
        raise SimulatorError(
            f"CARLA: this map has no straight lane of {STRAIGHT_M:g} m at a spawn point; load another, as Town04"
        )

    def _remove_cars(self) -> None:
        for actor in self._cars.values():
            actor.destroy()
        self._cars = {}


def _dot(at: Any, origin: Any, direction: Any) -> float:
    return float((at.x - origin.x) * direction.x + (at.y - origin.y) * direction.y)
