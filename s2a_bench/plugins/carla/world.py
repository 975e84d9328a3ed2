"""CARLA: a straight road, three cars and a camera on its server, which this process steps.

The lead and the trailing car get the speeds of their laws. The ego has CARLA's physics and is driven by its pedals: to
CARLA's Ackermann controller an acceleration is only a limit, and it needs more than a second to follow one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from pydantic import Field

from s2a_bench import extras
from s2a_bench.errors import SimulatorError, SourceError
from s2a_bench.frames import NumberedSource, check_size
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LANE_WIDTH_M, LEAD, REAR, ROLES, DriveCommand, State
from s2a_bench.scenario.windscreen import BEHIND_M, VIEW_DEG
from s2a_bench.types import Encoding, Pixels

CONNECT_S: Final = 10.0
ROAD_M, ORIGIN_M, END_M, MIDDLE_M, DROP_M = 1500.0, 250.0, 10.0, 1.5 * LANE_WIDTH_M, 0.3
"""The road in x, its position 0 and the margin at its ends; the cars' lane in y; the height from which they settle."""
LANE: Final = f"""
<lane id="{{}}" type="driving" level="false"><width sOffset="0" a="{LANE_WIDTH_M}" b="0" c="0" d="0"/>
<roadMark sOffset="0" type="{{}}" weight="standard" color="standard" width="0.15"/></lane>"""
OPENDRIVE: Final = f"""<?xml version="1.0"?>
<OpenDRIVE><header revMajor="1" revMinor="4" name="s2a-bench" north="0" south="0" east="0" west="0"/>
<road name="straight" length="{ROAD_M}" id="1" junction="-1">
<planView><geometry s="0" x="0" y="0" hdg="0" length="{ROAD_M}"><line/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false">
<roadMark sOffset="0" type="solid" weight="standard" color="standard" width="0.15"/></lane></center>
<right>{LANE.format(-1, "broken")}{LANE.format(-2, "broken")}{LANE.format(-3, "solid")}</right>
</laneSection></lanes></road></OpenDRIVE>"""
FORCED, FREE = 50, 50
"""Steps before the start: the ego is pushed to its speed, then drives itself, so that gears and pedals are settled."""
THROTTLE_MPS2, BRAKE_MPS2, GAIN_HZ, INTEGRAL_HZ2, OFF_MPS, REST_MPS = 4.0, 9.0, 1.5, 0.5, 1.0, 0.02
"""A full pedal, about; the loop around the speed; most that the wanted speed is off the real one; slower cars stand."""
LENGTHS: Final = np.array([1.0, 0.0, -1.0])
"""Car lengths from a position, which is bumper to bumper, to the car's centre."""


@dataclass(eq=False)
class CarlaWorld:
    """A world on a CARLA server, in place of its map; `close` restores settings and actors."""

    name: ClassVar[str] = "carla"
    real: ClassVar[bool] = True
    steers: ClassVar[bool] = False
    most: ClassVar[int | None] = 1
    over_ros: ClassVar[bool] = True
    step_s = 0.02

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 2000
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 60.0
    vehicle: str = "vehicle.tesla.model3"

    def __post_init__(self) -> None:
        """Take the server; raises SimulatorError, with everything restored."""
        carla = self._carla = extras.require("carla", "carla")
        self._undo, self._failed = ExitStack(), False
        self._contacts: list[tuple[int, int]] = []  # frame, and the other car
        self._past: deque[tuple[int, Floats]] = deque(maxlen=5)  # frame, and speeds
        client = self._client = carla.Client(self.host, self.port)
        client.set_timeout(min(self.timeout_s, CONNECT_S))
        try:
            with self._calls("connecting"):
                before = client.get_world().get_settings()
            client.set_timeout(self.timeout_s)
            with self._calls("making the road"):
                self._undo.callback(lambda: client.get_world().apply_settings(before))
                look = carla.OpendriveGenerationParameters(wall_height=0.0, enable_pedestrian_navigation=False)
                self._world = client.generate_opendrive_world(OPENDRIVE, look)
                settings = self._world.get_settings()
                settings.synchronous_mode, settings.fixed_delta_seconds = True, self.step_s
                self._world.apply_settings(settings)
            with self._calls("making the cars"):
                apart = (carla.Location(ORIGIN_M - 20.0 * car, MIDDLE_M, DROP_M) for car in (LEAD, EGO, REAR))
                self._cars = [self._spawn(self.vehicle, role, at) for role, at in zip(ROLES, apart, strict=True)]
                self._length = 2 * self._cars[EGO].bounding_box.extent.x
                bumper = self._spawn("sensor.other.collision", "bumper", carla.Location(), self._cars[EGO])
                bumper.listen(lambda event: self._contacts.append((event.frame, event.other_actor.id)))
        except BaseException:
            self.close()
            raise

    def _spawn(self, blueprint: str, role: str, at: Any, parent: Any = None, **attributes: object) -> Any:
        made_of = self._world.get_blueprint_library().find(blueprint)
        for key, value in {"role_name": role, "ros_name": role, **attributes}.items():
            made_of.set_attribute(key, str(value))
        actor = self._world.spawn_actor(made_of, self._carla.Transform(at), attach_to=parent)
        self._undo.callback(lambda: actor.is_alive and actor.destroy())
        self.frame = self._world.tick(self.timeout_s)  # until then the client takes it for dead
        return actor

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        carla, speed = self._carla, speed_mps[:, 0].astype(float)
        self._speed, self._crashed, self._started = speed, set[int](), np.inf
        start = ORIGIN_M + position_m[:, 0] + LENGTHS * self._length - speed * self.step_s
        with self._calls("placing the cars"):
            for car, x in zip(self._cars, (start - speed * self.step_s * (FORCED + FREE)).tolist(), strict=True):
                car.set_transform(carla.Transform(carla.Location(x, MIDDLE_M, DROP_M)))
                car.set_target_angular_velocity(carla.Vector3D())
            for step in range(FORCED + FREE):
                if step < FORCED:
                    self._wanted, self._sum = speed[EGO], 0.0
                self._advance(0.0, (LEAD, EGO, REAR) if step < FORCED else (LEAD, REAR))
            for car, x in zip(self._cars, start.tolist(), strict=True):  # which keeps speeds, springs and gears
                car.set_location(carla.Location(x, MIDDLE_M, car.get_location().z))
            self._started = self.frame
            return self._advance(0.0)

    def step(self, command: DriveCommand) -> State:
        acceleration = command.acceleration_mps2[:, 0]
        self._speed = np.maximum(self._speed + acceleration * self.step_s, 0.0)
        with self._calls("a step"):
            return self._advance(float(acceleration[EGO]))

    def camera(self, width: int, height: int) -> CarlaCamera:
        check_size(width, height)
        look = {"image_size_x": width, "image_size_y": height, "fov": VIEW_DEG}
        extent = self._cars[EGO].bounding_box.extent
        roof = self._carla.Location(extent.x - BEHIND_M, 0.0, 2 * extent.z)  # the inside of a car is drawn, too
        with self._calls("opening the camera"):
            sensor = self._spawn("sensor.camera.rgb", "front", roof, self._cars[EGO], **look)
            sensor.enable_for_ros()
            return CarlaCamera(sensor, width, height, self)

    def close(self) -> None:
        """Restore in reverse order; after an error, further failures are not reported."""
        with suppress(SimulatorError) if self._failed else ExitStack(), self._calls("restoring its settings"):
            self._undo.close()

    def _advance(self, ego_mps2: float, forced: tuple[int, ...] = (LEAD, REAR)) -> State:
        """Drive the cars through one tick, and look at them; NaN leaves the ego to its other driver."""
        for car in {*forced} - self._crashed:
            falling = self._cars[car].get_velocity().z
            self._cars[car].set_target_velocity(self._carla.Vector3D(float(self._speed[car]), 0.0, falling))
        if not np.isnan(ego_mps2):
            self._pedals(ego_mps2)
        self.frame = self._world.tick(self.timeout_s)
        x, y = np.array([(at.x, at.y) for at in (car.get_location() for car in self._cars)]).T
        if not END_M < x.min() < x.max() < ROAD_M - END_M:
            raise SimulatorError(f"`simulator`: a car leaves the road of carla, {ROAD_M:g} m, run-up included")
        position = x - ORIGIN_M - LENGTHS * self._length
        speed = np.array([mps if (mps := car.get_velocity().x) > REST_MPS else 0.0 for car in self._cars])
        for frame, other in self._contacts:
            for car in {LEAD, REAR} - self._crashed:
                if other == self._cars[car].id and frame > self._started:
                    # The forces have changed the speeds within that tick, and bodies are not quite boxes.
                    self._crashed.add(car)
                    position[car] = position[EGO]
                    speed = next((before for tick, before in reversed(self._past) if tick < frame), speed)
        self._past.append((self.frame, speed))
        return State(position[:, np.newaxis], speed[:, np.newaxis], (MIDDLE_M - y)[:, np.newaxis])

    def _pedals(self, command: float) -> None:
        """Feed the command forward, with a proportional-integral loop around the speed that follows from it."""
        speed = self._cars[EGO].get_velocity().x
        self._wanted = np.clip(max(self._wanted + command * self.step_s, 0.0), speed - OFF_MPS, speed + OFF_MPS)
        self._sum += (self._wanted - speed) * self.step_s
        wish = command + GAIN_HZ * (self._wanted - speed) + INTEGRAL_HZ2 * self._sum
        brake = 1.0 if max(self._wanted, speed) < REST_MPS and command <= 0 else np.clip(-wish / BRAKE_MPS2, 0, 1)
        throttle = np.clip(wish / THROTTLE_MPS2, 0, 1 - brake)
        self._cars[EGO].apply_control(self._carla.VehicleControl(throttle=float(throttle), brake=float(brake)))

    @contextmanager
    def _calls(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (RuntimeError, IndexError) as error:
            self._failed = True
            self._client.set_timeout(1.0)
            out = "start its server (CarlaUE4.sh), or name another one: carla?host=H&port=P&timeout_s=T"
            raise SimulatorError(f"`simulator`: CARLA at {self.host}:{self.port}, {doing}: {error}; {out}") from error


class CarlaCamera(NumberedSource):
    """A sensor's pictures as (h, w, 3) ``bgr8``; a `read` waits for the one of the world's last step."""

    encoding: Encoding = "bgr8"

    def __init__(self, sensor: Any, width: int, height: int, world: CarlaWorld) -> None:
        super().__init__("carla", width, height)
        self._sensor, self._world = sensor, world
        self._newest: deque[Any] = deque(maxlen=1)
        sensor.listen(self._newest.append)

    def close(self) -> None:
        super().close()
        if self._sensor.is_alive:
            self._sensor.destroy()

    def _picture(self) -> Pixels:
        tick, give_up = self._world.frame, monotonic() + self._world.timeout_s
        while not self._newest or self._newest[0].frame < tick:
            if monotonic() > give_up:
                raise SourceError("`simulator`: no picture of CARLA's last step; open the camera before placing cars")
            sleep(0.001)
        pixels = np.frombuffer(self._newest[0].raw_data, np.uint8).reshape(self.height, self.width, 4)
        return np.ascontiguousarray(pixels[..., :3])
