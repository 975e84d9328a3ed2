"""The ego of a world over ROS 2, as CARLA has it: commands go out on a topic, pictures come in on another."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.frames.ros import TopicCamera
from s2a_bench.policy import Floats
from s2a_bench.policy.parameters import build, canonical
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.join import RosParameters
from s2a_bench.ros.remap import ABSOLUTE
from s2a_bench.ros.service import MATCH_POLL_S, appeared
from s2a_bench.scenario import EGO, SIMULATORS, DriveCommand, Simulator, State

CONTROL: Final = "carla_msgs/msg/CarlaEgoVehicleControl"
DRIVE: Final = "ackermann_msgs/msg/AckermannDrive"
COMMANDS: Final = {
    ("native", "control"): ("/carla/ego/vehicle_control_cmd", CONTROL),
    ("native", "ackermann"): ("/carla/ego/ackermann_control_cmd", DRIVE + "Stamped"),
    ("bridge", "control"): ("/carla/ego_vehicle/vehicle_control_cmd", CONTROL),
    ("bridge", "ackermann"): ("/carla/ego_vehicle/ackermann_cmd", DRIVE),
}
PICTURES: Final = {"native": "/carla/ego/front/image", "bridge": "/carla/ego_vehicle/rgb_front/image"}
NAME: Final = f"^{ABSOLUTE.pattern}$"
FULL_THROTTLE_MPS2, FULL_BRAKE_MPS2, ROLLING_MPS2, AIR_PER_M, REST_MPS = 4.0, 9.0, 0.1, 0.0003, 0.1
"""Values of no particular car: a car's deviation is its error. Below the last, the brake holds it."""


@dataclass(frozen=True, slots=True)
class EgoParameters(RosParameters):
    """Topics are those of ``preset``, CARLA's own or its older bridge's, or ``command`` and ``picture``."""

    preset: Literal["native", "bridge"] = "native"
    message: Literal["control", "ackermann"] = "control"
    command: Annotated[str, Field(pattern=NAME)] = ""
    picture: Annotated[str, Field(pattern=NAME)] = ""


def ego_parameters(written: str, world: type[Simulator]) -> EgoParameters:
    """Read ``ros[?parameter=value&...]``; raises UsageError, also for a simulator without ROS 2."""
    if written.partition("?")[0] != "ros":
        raise UsageError(f"`ego`: '{written}' should be ros, with parameters as in ros?preset=bridge")
    if not world.over_ros:
        able = ", ".join(name for name, each in SIMULATORS.loaded() if each.over_ros)
        raise UsageError(
            f"`ego`: the {world.name} simulator has no ROS 2; take a `simulator` that has: {able or 'none here'}"
        )
    return build(EgoParameters, written, "ego")


def message(type_name: str, acceleration_mps2: float, speed_mps: float) -> Any:
    """Return a command, straight on; its speed is of a second later, as CARLA takes an acceleration's sign from it."""
    rests, header = speed_mps < REST_MPS and acceleration_mps2 <= 0, ros.header(time.time_ns())
    if type_name == CONTROL:
        pedal = acceleration_mps2 + ROLLING_MPS2 + AIR_PER_M * speed_mps**2
        throttle, brake = (0.0, 1.0) if rests else np.clip((pedal / FULL_THROTTLE_MPS2, -pedal / FULL_BRAKE_MPS2), 0, 1)
        return ros.default(CONTROL, header=header, throttle=throttle, brake=brake)
    speed = 0.0 if rests else max(speed_mps + acceleration_mps2, REST_MPS)
    drive = ros.default(DRIVE, speed=speed, acceleration=acceleration_mps2)
    return drive if type_name == DRIVE else ros.default(type_name, header=header, drive=drive)


class EgoCamera(TopicCamera):
    """A topic whose pictures come as the world is stepped: `read` repeats the last, with its stamp, until the next."""

    option: ClassVar[str] = "ego"
    _stamp_ns = 0

    def renew(self, step: Callable[[], State]) -> None:
        """Step until a third picture has come; one may have been unread, and one on its way."""
        for _ in range(0 if self._closed else 3):
            with self.errors():
                appeared(lambda: step() is not None and self._newest is not None, self._wait_s)
                self._stamp_ns = super()._grab()

    def _grab(self) -> int:
        if self._newest is not None:
            self._stamp_ns = super()._grab()
        return self._stamp_ns


class RosEgo:
    """A simulator whose ego is commanded and seen over ROS 2; all else is the wrapped world's, `close` included.

    It derives from no `Simulator`, whose defaults would hide the world's own.
    """

    def __init__(self, world: Simulator, how: EgoParameters) -> None:
        topic, self._type = COMMANDS[how.preset, how.message]
        self._world, self._how, self._topic, self.step_s = world, how, how.command or topic, world.step_s
        self._sensors: list[Any] = []
        self._cameras: list[EgoCamera] = []
        try:
            self._publisher, self._node = how.join(
                "/s2a_bench/ego", lambda node: (node.publisher(self._topic, self._type, QoS(depth=1)), node)
            )
        except TransportError as error:
            raise type(error)(f"`ego`: ros: {error}") from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Restart, with a camera once more when it has seen the cars there; raises TransportError, SourceError."""
        self._world.step_s = self.step_s  # a run may choose it
        self._state = self._world.place(position_m, speed_mps)
        if not appeared(lambda: self._publisher.matched() > 0, self._how.wait_s):
            raise TransportError(
                f"`ego`: ros: no subscriber of {self._topic} ({self._type}) appeared in {self._how.wait_s:g} s; start "
                "CARLA with --ros2, or give the ego its preset, command, domain_id or middleware (?preset=bridge)"
            )
        for camera in self._cameras:
            camera.renew(self._coast)
            self._state = self._world.place(position_m, speed_mps)
        return self._state

    def step(self, command: DriveCommand) -> State:
        others = command.acceleration_mps2.copy()
        sent = message(self._type, float(others[EGO, 0]), float(self._state.speed_mps[EGO, 0]))
        self._publisher.send(self._publisher.pack(sent))
        others[EGO] = np.nan
        self._state = self._world.step(replace(command, acceleration_mps2=others))
        return self._state

    def camera(self, width: int, height: int) -> EgoCamera:
        """Open the world's camera, for its sensor, and the topic, stepping meanwhile; places the cars."""
        self._sensors.append(self._world.camera(width, height))
        self.place(np.array([[40.0], [0.0], [-40.0]]), np.zeros((3, 1)))
        where, how = self._how.picture or PICTURES[self._how.preset], self._how
        shared = {each.name: getattr(how, each.name) for each in fields(RosParameters)}
        where = canonical(where, RosParameters(**shared))
        with ThreadPoolExecutor(1) as threads:
            opening = threads.submit(lambda: self._cameras.append(EgoCamera(where, width, height)))
            while not wait([opening], MATCH_POLL_S).done:
                self._coast()
        opening.result()
        return self._cameras[-1]

    def close(self) -> None:
        for each in (*self._cameras, *self._sensors, self._node, self._world):
            each.close()

    def _coast(self) -> State:
        return self.step(DriveCommand(np.zeros((3, 1)), np.zeros(1, np.int64)))


def with_ego(world: Simulator, written: str) -> Simulator:
    """Return a world with its ego as ``ros[?parameter=value&...]``, or as it is; raises TransportError."""
    return RosEgo(world, ego_parameters(written, type(world))) if written else world  # type: ignore[return-value]
