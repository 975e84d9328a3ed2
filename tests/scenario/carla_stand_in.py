"""A stand-in of the part of CARLA's client API that the adapter uses: one straight road along x, point-mass cars."""

from __future__ import annotations

import math
import types
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass
class Vector3D:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Rotation:
    yaw: float = 0.0


@dataclass
class Transform:
    location: Vector3D
    rotation: Rotation = field(default_factory=Rotation)

    def get_forward_vector(self) -> Vector3D:
        return Vector3D(math.cos(math.radians(self.rotation.yaw)), math.sin(math.radians(self.rotation.yaw)))

    def get_right_vector(self) -> Vector3D:
        ahead = self.get_forward_vector()
        return Vector3D(-ahead.y, ahead.x)


@dataclass
class Waypoint:
    road: World
    at: float

    @property
    def transform(self) -> Transform:
        bent = self.at > self.road.straight_m
        return Transform(Vector3D(self.at, 7.0), Rotation(30.0 if bent else 0.0))

    def next(self, distance: float) -> list[Waypoint]:
        assert distance > 0, "CARLA refuses other distances"
        return [Waypoint(self.road, self.at + distance)]


@dataclass
class Settings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float | None = None


class Actor:
    def __init__(self, world: World, transform: Transform) -> None:
        self.world, self._transform, self._velocity = world, transform, Vector3D()
        self.bounding_box = types.SimpleNamespace(extent=Vector3D(2.4, 1.0, 0.8))

    def get_transform(self) -> Transform:
        return self._transform

    def get_location(self) -> Vector3D:
        return replace(self._transform.location)

    def get_velocity(self) -> Vector3D:
        return replace(self._velocity)

    def set_target_velocity(self, velocity: Vector3D) -> None:
        self._velocity = velocity

    def destroy(self) -> bool:
        self.world.actors.remove(self)
        return True


class Blueprint:
    def set_attribute(self, name: str, value: str) -> None:
        assert (name, value) in {("role_name", car) for car in ("lead", "ego", "rear")}


class World:
    def __init__(self) -> None:
        self.settings, self.actors, self.ticks = Settings(), [], 0
        self.straight_m, self.full, self.gone = 1e6, False, False

    def get_settings(self) -> Settings:
        return replace(self.settings)

    def apply_settings(self, settings: Settings) -> None:
        self.settings = replace(settings)

    def get_blueprint_library(self) -> Any:
        return types.SimpleNamespace(find=lambda _name: Blueprint())

    def get_map(self) -> Any:
        spawn = Transform(Vector3D(100.0, 7.0))
        return types.SimpleNamespace(
            get_spawn_points=lambda: [spawn], get_waypoint=lambda location: Waypoint(self, location.x)
        )

    def try_spawn_actor(self, _blueprint: Blueprint, transform: Transform) -> Actor | None:
        if self.full:
            return None
        self.actors.append(Actor(self, transform))
        return self.actors[-1]  # type: ignore[no-any-return]

    def tick(self) -> int:
        if self.gone:
            raise RuntimeError("time-out of 10000ms while waiting for the simulator")
        assert self.settings.synchronous_mode
        assert self.settings.fixed_delta_seconds
        for actor in self.actors:
            actor._transform.location.x += actor._velocity.x * self.settings.fixed_delta_seconds
            actor._transform.location.y += actor._velocity.y * self.settings.fixed_delta_seconds
        self.ticks += 1
        return self.ticks


def package(world: World | None) -> types.ModuleType:
    """Make a module ``carla`` whose server has this world; None: no server answers."""

    class Client:
        def __init__(self, host: str, port: int) -> None:
            self.address = f"{host}:{port}"

        def set_timeout(self, seconds: float) -> None:
            assert seconds > 0

        def get_world(self) -> World:
            if world is None:
                raise RuntimeError(
                    "time-out of 10000ms while waiting for the simulator, make sure the simulator is ready and "
                    f"connected to {self.address}"
                )
            return world

    module = types.ModuleType("carla")
    module.Client, module.Vector3D = Client, Vector3D  # type: ignore[attr-defined]
    return module
