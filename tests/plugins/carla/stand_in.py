"""A stand-in for the `carla` module and its server: cars along x with late pedals, cold gears, and bodies that collide.

Only what the simulator uses is here, under the names of the real client; `test_client.py` holds it to the wheel's.
A car that was given a speed has it for one step. The ego's pedals act `LATE_S` late and differ from what the simulator
assumes; a car that has just been put down loses speed, as CARLA's do until they are in gear.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Thread
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

LATE_S = 0.2
FULL_THROTTLE, FULL_BRAKE, DRAG, COLD_DRAG, COLD_S = 4.4, 8.2, 0.2, 3.0, 0.5
LENGTH_M, HEIGHT_M = 4.8, 1.5
BODY_M = 0.03
"""A body is longer than its box by this."""
BLUEPRINTS = ("vehicle.tesla.model3", "sensor.camera.rgb", "sensor.other.collision")


@dataclass
class Vector3D:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Location(Vector3D):
    pass


@dataclass
class Transform:
    location: Location = field(default_factory=Location)


@dataclass(kw_only=True)
class VehicleControl:
    throttle: float = 0.0
    brake: float = 0.0


@dataclass(kw_only=True)
class OpendriveGenerationParameters:
    wall_height: float = 1.0
    enable_pedestrian_navigation: bool = True


@dataclass(kw_only=True)
class WorldSettings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float | None = None


@dataclass
class Server:
    """What outlives its clients: settings, the map, actors."""

    settings: tuple[bool, float | None] = (False, None)
    map: str = "Town10HD_Opt"
    actors: list[Actor] = field(default_factory=list)
    attributes: dict[str, dict[str, str]] = field(default_factory=dict)
    """Of every actor that there was, by role."""
    frame: int = 0
    fails: dict[str, str] = field(default_factory=dict)
    """Name of a call -> the text of what it raises."""
    late_events: bool = True
    """Whether contacts are told a tick late, as happens."""
    draws: bool = True
    timeout_s: float = 0.0

    def call(self, name: str) -> None:
        if name in self.fails:
            raise RuntimeError(self.fails[name])


SERVER = Server()


class Actor:
    def __init__(self, blueprint: ActorBlueprint, location: Any, parent: Actor | None) -> None:
        self.id = len(SERVER.attributes) + 100
        self._blueprint, self._parent, self._alive = blueprint, parent, True
        self._at, self._velocity = [location.x, location.y, location.z], [0.0, 0.0, 0.0]
        SERVER.attributes[blueprint.attributes["role_name"]] = blueprint.attributes
        SERVER.actors.append(self)

    @property
    def is_alive(self) -> bool:
        return self._alive and self._seen

    def destroy(self) -> bool:
        assert self._alive, "the real client warns of an actor that is already dead"
        assert self._seen, "to the real client, an actor is dead until a step has shown it"
        SERVER.call("destroy")
        self._alive = False
        SERVER.actors.remove(self)
        return True

    def get_location(self) -> Any:
        return MODULE.Location(*(float(np.float32(each)) for each in self._at))

    def get_velocity(self) -> Any:
        return MODULE.Vector3D(*self._velocity)

    def set_transform(self, transform: Any) -> None:
        self.set_location(transform.location)
        self._warm_s, self._pedals = 0.0, deque([(0.0, 0.0)] * len(self._pedals), self._pedals.maxlen)

    def set_location(self, location: Any) -> None:
        self._at = [location.x, location.y, location.z]

    def set_target_velocity(self, velocity: Any) -> None:
        self._target = velocity.x

    def set_target_angular_velocity(self, angular_velocity: Any) -> None:
        assert angular_velocity.z == 0.0

    _seen = False
    _target: float | None = None
    _warm_s = 0.0
    _pedals: ClassVar[deque[tuple[float, float]]] = deque(maxlen=1)


class Vehicle(Actor):
    def __init__(self, blueprint: ActorBlueprint, location: Any, parent: Actor | None) -> None:
        super().__init__(blueprint, location, parent)
        self._pedals = deque([(0.0, 0.0)] * 10, 10)
        self._control = (0.0, 0.0)

    @property
    def bounding_box(self) -> Any:
        return SimpleNamespace(extent=MODULE.Vector3D(LENGTH_M / 2, 0.9, HEIGHT_M / 2))

    def apply_control(self, control: Any) -> None:
        assert 0 <= control.throttle <= 1
        assert 0 <= control.brake <= 1
        self._control = (control.throttle, control.brake)

    def tick(self, step_s: float) -> None:
        throttle, brake = self._pedals[0]
        self._pedals.append(self._control)
        speed = self._velocity[0] if self._target is None else self._target
        if self._target is None:
            drag = (DRAG if self._warm_s >= COLD_S else COLD_DRAG) if speed > 0 else 0.0
            speed = max(speed + (throttle * FULL_THROTTLE - brake * FULL_BRAKE - drag) * step_s, 0.0)
        self._target = None
        self._warm_s += step_s
        self._at[0] += speed * step_s
        self._at[2] = max(self._at[2] - 0.05, 0.0)
        # At rest the solver trembles.
        self._velocity = [speed or 1e-3 * (-1) ** SERVER.frame, 0.0, -2.5 if self._at[2] > 0 else 0.0]


class Sensor(Actor):
    callback: Callable[[Any], None] | None = None

    def listen(self, callback: Callable[[Any], None]) -> None:
        SERVER.call("listen")
        self.callback = callback


class ServerSideSensor(Sensor):
    def enable_for_ros(self) -> None:
        self._blueprint.attributes["over_ros"] = "yes"


@dataclass
class CollisionEvent:
    frame: int
    other_actor: Actor


@dataclass
class Image:
    frame: int
    raw_data: memoryview


@dataclass
class ActorBlueprint:
    id: str
    attributes: dict[str, str]

    def set_attribute(self, name: str, value: str) -> None:
        assert isinstance(value, str)
        self.attributes[name] = value


class BlueprintLibrary:
    def find(self, id: str) -> ActorBlueprint:  # noqa: A002 - the client's name
        if id not in BLUEPRINTS:
            raise IndexError(f"blueprint '{id}' not found")
        return ActorBlueprint(id, {})


class World:
    def get_settings(self) -> Any:
        settings = MODULE.WorldSettings()
        settings.synchronous_mode, settings.fixed_delta_seconds = SERVER.settings
        return settings

    def apply_settings(self, settings: Any) -> int:
        SERVER.call("apply_settings")
        SERVER.settings = (settings.synchronous_mode, settings.fixed_delta_seconds)
        return SERVER.frame

    def get_blueprint_library(self) -> BlueprintLibrary:
        return BlueprintLibrary()

    def spawn_actor(self, blueprint: ActorBlueprint, transform: Any, attach_to: Actor | None = None) -> Actor:
        SERVER.call(f"spawn_actor {blueprint.attributes['role_name']}")
        kind = ServerSideSensor if blueprint.id.startswith("sensor") else Vehicle
        assert transform.location.z > 0 or kind is ServerSideSensor
        return kind(blueprint, transform.location, attach_to)

    def tick(self, seconds: float = 0.0) -> int:
        SERVER.call("tick")
        assert SERVER.settings == (True, 0.02)
        assert seconds > 0
        SERVER.frame += 1
        for actor in SERVER.actors:
            actor._seen = True
        cars = [each for each in SERVER.actors if isinstance(each, Vehicle)]
        for car in cars:
            car.tick(0.02)
        _collide(cars)
        for sensor in [each for each in SERVER.actors if isinstance(each, ServerSideSensor)]:
            if sensor.callback is not None and sensor._blueprint.id == "sensor.camera.rgb" and SERVER.draws:
                # From a thread of the client, a little later.
                Thread(target=sensor.callback, args=(_picture(sensor, cars),)).start()
        return SERVER.frame


EVENTS: list[tuple[ServerSideSensor, CollisionEvent]] = []


def _collide(cars: list[Vehicle]) -> None:
    """Bodies that touch go on at their mean speed; who listens is told, perhaps a tick late."""
    due, EVENTS[:] = EVENTS[:], []
    for one in cars:
        for other in cars:
            gap = other._at[0] - one._at[0] - LENGTH_M - BODY_M
            if one is not other and other._at[0] > one._at[0] and gap <= 0:
                one._at[0] += gap
                one._velocity[0] = other._velocity[0] = (one._velocity[0] + other._velocity[0]) / 2
                for sensor in [each for each in SERVER.actors if isinstance(each, ServerSideSensor)]:
                    pair = {one: other, other: one}
                    if sensor._blueprint.id == "sensor.other.collision" and sensor._parent in pair:
                        EVENTS.append((sensor, CollisionEvent(SERVER.frame, pair[sensor._parent])))  # type: ignore[index]
    for sensor, event in due if SERVER.late_events else due + EVENTS:
        assert sensor.callback is not None
        sensor.callback(event)
    if not SERVER.late_events:
        EVENTS.clear()


def _picture(camera: ServerSideSensor, cars: list[Vehicle]) -> Image:
    """Draw the cars ahead as grey blocks, as (h, w, 4) BGRA."""
    look = camera._blueprint.attributes
    width, height = int(look["image_size_x"]), int(look["image_size_y"])
    pixels = np.full((height, width, 4), (200, 150, 100, 255), np.uint8)
    assert camera._parent is not None
    for gap in sorted(car._at[0] - camera._parent._at[0] - LENGTH_M for car in cars)[::-1]:
        if gap > 0.5:
            half = int(width / math.tan(math.radians(float(look["fov"]) / 2)) * 0.45 / gap)
            pixels[height // 2 : height // 2 + 2 * half, width // 2 - half : width // 2 + half, :3] = (60, 60, 60)
    return Image(SERVER.frame, memoryview(pixels.tobytes()))


class Client:
    def __init__(self, host: str = "127.0.0.1", port: int = 2000) -> None:
        self._at = (host, port)

    def set_timeout(self, seconds: float) -> None:
        SERVER.timeout_s = seconds

    def get_world(self) -> World:
        SERVER.call("get_world")
        return World()

    def generate_opendrive_world(self, opendrive: str, parameters: Any) -> World:
        SERVER.call("generate_opendrive_world")
        assert parameters.wall_height == 0.0
        SERVER.map, SERVER.settings = opendrive, (False, None)
        SERVER.actors.clear()
        return World()


CLASSES = (
    *(Client, World, Actor, Vehicle, Sensor, ServerSideSensor, ActorBlueprint, BlueprintLibrary, CollisionEvent, Image),
    *(Vector3D, Location, Transform, VehicleControl, OpendriveGenerationParameters, WorldSettings),
)
VALUES = ("Vector3D", "Location", "Transform", "VehicleControl", "OpendriveGenerationParameters", "WorldSettings")
"""Classes that do without a server: those of the wheel may take their place."""
MODULE: Any = SimpleNamespace(**{each.__name__: each for each in CLASSES})


def fresh(values: Any = None) -> Any:
    """Return the module, with the values of the real client if it is given, on a server that was just started."""
    own = {each.__name__: each for each in CLASSES}
    vars(MODULE).update(own, **{name: getattr(values, name) for name in VALUES} if values else {})
    vars(SERVER).update(vars(Server()))
    EVENTS.clear()
    return MODULE
