"""CARLA's part of a drive over ROS 2, played by the embedded simulator under the same names and types."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from s2a_bench.frames import FrameSource
from s2a_bench.ros import Middleware, QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.scenario import EGO, DriveCommand, State
from s2a_bench.scenario.embedded import Embedded

CONTROL = "carla_msgs/msg/CarlaEgoVehicleControl"
STAMPED = "ackermann_msgs/msg/AckermannDriveStamped"
PLAIN = "ackermann_msgs/msg/AckermannDrive"
QUEUE = QoS(depth=1)


NATIVE = ("/carla/ego/vehicle_control_cmd", "/carla/ego/front/image")


class RosWorld(Embedded):
    """Its ego does what the newest command says, whatever `step` is given; each step shows a picture.

    CARLA steps with the command that it has. This world waits for the one of the step, so that drives are the same each
    time.
    """

    over_ros: ClassVar[bool] = True

    def __init__(self, node: Middleware, type_name: str, commands: str, pictures: str, *, wait_s: float = 20) -> None:
        super().__init__()
        self._node, self._type, self._wait_s = node, type_name, wait_s
        self._commands = node.subscription(commands, type_name, QUEUE)
        self._pictures = node.publisher(pictures, ros.IMAGE, QUEUE)
        self._eye: FrameSource | None = None
        self.received: list[Any] = []
        self.closed = 0
        self.blind = False
        self.breaks: Exception | None = None

    def place(self, position_m: Any, speed_mps: Any) -> State:
        self.state = super().place(position_m, speed_mps)
        return self.state

    def step(self, command: DriveCommand) -> State:
        assert np.isnan(command.acceleration_mps2[EGO]).all()
        assert not np.isnan(command.acceleration_mps2).all(axis=1)[[0, 2]].any()
        if self.breaks:
            raise self.breaks
        packed = self._commands.take(self._wait_s)
        assert packed is not None, "no command came"
        self.received.append(self._commands.unpack(packed))
        acceleration = command.acceleration_mps2.copy()
        acceleration[EGO] = self._acceleration_of(self.received[-1])
        self.state = super().step(replace(command, acceleration_mps2=acceleration))
        if self._eye and not self.blind:
            self._publish(self._eye)
        return self.state

    def camera(self, width: int, height: int) -> Any:
        self._eye = super().camera(width, height)
        return self._eye

    def close(self) -> None:
        self.closed += 1
        self._node.close()

    def _acceleration_of(self, message: Any) -> float:
        """A car of 4 m/s2 at full throttle and 9 m/s2 at full brake, less what rolling and the air take."""
        if self._type == CONTROL:
            speed = self.state.speed_mps[EGO, 0]
            assert (message.steer, message.gear, message.hand_brake, message.reverse) == (0, 0, False, False)
            return float(4.0 * message.throttle - 9.0 * message.brake - 0.1 - 0.0003 * speed**2)
        return float((message.drive if self._type == STAMPED else message).acceleration)

    def _publish(self, eye: FrameSource) -> None:
        pixels = np.dstack([eye.read().data, np.full((eye.height, eye.width), 255, np.uint8)])
        image = ros.message(
            ros.IMAGE,
            header=ros.header(time.time_ns(), "front"),
            height=eye.height,
            width=eye.width,
            encoding="bgra8",
            is_bigendian=0,
            step=4 * eye.width,
            data=pixels.reshape(-1),
        )
        self._pictures.send(self._pictures.pack(image))


class RosSimulator(RosWorld):
    """As a registered simulator: it opens a node of its own, in steps that a picture each allows on the clock."""

    name: ClassVar[str] = "stand-in"
    opened: ClassVar[list[RosWorld]] = []
    step_s = 0.04

    def __init__(self) -> None:
        super().__init__(open_middleware("cyclonedds", node_name="/carla"), CONTROL, *NATIVE)
        self.opened.append(self)
