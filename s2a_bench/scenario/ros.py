"""The ego of a world over ROS 2, as CARLA's nodes have it: commands go out on a topic, pictures come in on another.

The simulator does not wait for a command: it applies the newest that it has received, at its best that of this step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Final, Literal

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.frames import FrameSource
from s2a_bench.frames.ros import TopicCamera
from s2a_bench.policy import Floats
from s2a_bench.policy.parameters import canonical
from s2a_bench.ros import Middleware, Publisher, QoS, RosParameters
from s2a_bench.ros import messages as ros
from s2a_bench.ros.remap import NODE_NAME as NAME
from s2a_bench.ros.service import MATCH_POLL_S, appeared
from s2a_bench.scenario import EGO, DriveCommand, Simulator, State

CONTROL: Final = "carla_msgs/msg/CarlaEgoVehicleControl"
DRIVE: Final = "ackermann_msgs/msg/AckermannDrive"
COMMANDS: Final = {
    ("native", "control"): ("/carla/ego/vehicle_control_cmd", CONTROL),
    ("native", "ackermann"): ("/carla/ego/ackermann_control_cmd", DRIVE + "Stamped"),
    ("bridge", "control"): ("/carla/ego_vehicle/vehicle_control_cmd", CONTROL),
    ("bridge", "ackermann"): ("/carla/ego_vehicle/ackermann_cmd", DRIVE),
}
"""(preset, message) -> topic and type of the commands."""
PICTURES: Final = {"native": "/carla/ego/front/image", "bridge": "/carla/ego_vehicle/rgb_front/image"}
QUEUE: Final = QoS(depth=1)
"""As of CARLA's own subscriptions: reliable, volatile, the last."""
FULL_THROTTLE_MPS2, FULL_BRAKE_MPS2 = 4.0, 8.0
ROLLING_MPS2, AIR_PER_M = 0.1, 0.0003
"""Of no car in particular; what a car does instead is its error, and is not corrected."""
REST_MPS: Final = 0.1
"""A slower car that is not to accelerate is held by the brake, as CARLA's Ackermann controller does."""
AHEAD_S, LEAST_MPS = 1.0, 0.05
"""CARLA takes the sign of an acceleration from the speed, hence of a second later; at 0 its bridge brakes fully."""
PICTURE_S: Final = 0.05
"""So long a picture may be on its way."""
START_M: Final = np.array([[40.0], [0.0], [-40.0]])


@dataclass(frozen=True, slots=True)
class EgoParameters(RosParameters):
    """Topics of ``preset``, CARLA's own ROS 2 or its older bridge, where ``command`` or ``picture`` name none."""

    preset: Literal["native", "bridge"] = "native"
    message: Literal["control", "ackermann"] = "control"
    command: str = ""
    picture: str = ""

    def __post_init__(self) -> None:
        RosParameters.__post_init__(self)
        for name in ("command", "picture"):
            if (topic := getattr(self, name)) and not NAME.fullmatch(topic):
                raise UsageError(f"{name} = '{topic}' should look like {PICTURES['native']}")


def pedals(acceleration_mps2: float, speed_mps: float) -> tuple[float, float]:
    """Return throttle and brake, 0 to 1, of a mid-size car on a level road."""
    if speed_mps < REST_MPS and acceleration_mps2 <= 0:
        return 0.0, 1.0
    drive_mps2 = acceleration_mps2 + ROLLING_MPS2 + AIR_PER_M * speed_mps**2
    return min(max(drive_mps2 / FULL_THROTTLE_MPS2, 0.0), 1.0), min(max(-drive_mps2 / FULL_BRAKE_MPS2, 0.0), 1.0)


def message(type_name: str, acceleration_mps2: float, speed_mps: float) -> Any:
    """Return a command of one of the types of `COMMANDS`, steering straight on, stamped now."""
    if type_name == DRIVE:
        speed = 0.0
        if acceleration_mps2 > 0 or speed_mps >= REST_MPS:
            speed = max(speed_mps + acceleration_mps2 * AHEAD_S, LEAST_MPS)
        return ros.default(DRIVE, speed=speed, acceleration=acceleration_mps2)
    header = ros.header(time.time_ns())
    if type_name == CONTROL:
        throttle, brake = pedals(acceleration_mps2, speed_mps)
        return ros.default(CONTROL, header=header, throttle=throttle, brake=brake)
    return ros.default(type_name, header=header, drive=message(DRIVE, acceleration_mps2, speed_mps))


class EgoCamera(TopicCamera):
    """A topic whose pictures come only while the world is stepped: `read` repeats the last one while it is not."""

    option: ClassVar[str] = "ego"

    def renew(self, step: Callable[[], object]) -> None:
        """Step until two pictures have come, unless closed; the first may have been on its way before."""
        if self._closed:
            return

        def stepped() -> bool:
            step()
            return self._newest is not None

        with self.errors():
            for _ in range(2):
                if self._newest is not None:
                    super()._grab()
                if not appeared(stepped, self._wait_s):
                    self._wait()

    def _grab(self) -> int:
        asked_ns = now_ns()
        with self._changed:
            if not self._changed.wait_for(lambda: self._newest, PICTURE_S):
                return asked_ns
        return super()._grab()


class RosEgo:
    """A simulator whose ego is commanded and seen over ROS 2; all else is the wrapped world's, `close` included."""

    name: ClassVar[str]
    real: ClassVar[bool]
    steers: ClassVar[bool]
    most: ClassVar[int | None]
    over_ros: ClassVar[bool]
    step_s: float

    def __init__(self, world: Simulator, how: EgoParameters) -> None:
        """Join the domain; raises TransportError."""
        self._world, self._how = world, how
        topic, self._type = COMMANDS[how.preset, how.message]
        self._topic = how.command or topic
        self._cameras: list[FrameSource] = []
        self._seen: list[EgoCamera] = []
        self._state: State

        def opened(node: Middleware) -> tuple[Middleware, Publisher]:
            publisher = node.publisher(self._topic, self._type, QUEUE)
            publisher.pack(message(self._type, 0.0, 0.0))  # the first packing takes milliseconds
            return node, publisher

        try:
            self._middleware, self._publisher = how.join("/s2a_bench/ego", opened)
        except TransportError as error:
            raise type(error)(f"`ego`: ros: {error}") from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Restart; with a camera the cars are placed twice, the first time until it shows them."""
        self._state = self._world.place(position_m, speed_mps)
        if not appeared(lambda: self._publisher.matched() > 0, self._how.wait_s):
            raise TransportError(
                f"`ego`: ros: no subscriber of {self._topic} ({self._type}) appeared in {self._how.wait_s:g} s; start "
                "CARLA with --ros2, or its bridge with ?preset=bridge, on the ROS_DOMAIN_ID and middleware of this "
                "(?domain_id=, ?middleware=), or name the topic with ?command="
            )
        for camera in self._seen:
            camera.renew(self._coast)
            self._state = self._world.place(position_m, speed_mps)
        return self._state

    def step(self, command: DriveCommand) -> State:
        wanted, speed = command.acceleration_mps2, self._state.speed_mps[EGO, 0]
        self._publisher.send(self._publisher.pack(message(self._type, float(wanted[EGO, 0]), float(speed))))
        others = wanted.copy()
        others[EGO] = np.nan
        self._state = self._world.step(replace(command, acceleration_mps2=others))
        return self._state

    def camera(self, width: int, height: int) -> EgoCamera:
        """Open the world's camera, for its sensor, and then the topic, stepping until there is a picture.

        Places the cars. Raises SourceError.
        """
        self._cameras.append(self._world.camera(width, height))
        self.place(START_M, np.zeros((3, 1)))
        parameters = (getattr(self._how, field.name) for field in fields(RosParameters))
        where = canonical(self._how.picture or PICTURES[self._how.preset], RosParameters(*parameters))
        with ThreadPoolExecutor(1) as threads:
            opening = threads.submit(EgoCamera, where, width, height)
            opening.add_done_callback(self._opened)
            while not wait([opening], MATCH_POLL_S).done:
                self._coast()
        return opening.result()

    def close(self) -> None:
        for camera in (*self._seen, *self._cameras):
            camera.close()
        self._middleware.close()
        self._world.close()

    def _coast(self) -> State:
        return self.step(DriveCommand(np.zeros((3, 1)), np.zeros(1, np.int64)))

    def _opened(self, opening: Future[EgoCamera]) -> None:
        if not opening.exception():
            self._seen.append(opening.result())
