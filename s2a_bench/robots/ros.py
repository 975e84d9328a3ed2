"""A robot behind a ROS 2 topic: every action is a message, as trajectory controllers or forward controllers take it.

A message of trajectory_msgs/JointTrajectory has one point, to be reached one control period after it came: its header
has no stamp, which by convention means "now". In a stall nothing is published: a controller holds what it has.
"""

from __future__ import annotations

import os
import re
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import Field

from s2a_bench.errors import RobotError, UsageError
from s2a_bench.ros import MIDDLEWARES, Middleware, QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.config import domain_id
from s2a_bench.ros.router import ROUTER, Router, endpoint_of
from s2a_bench.ros.waiting import appeared

if TYPE_CHECKING:
    from s2a_bench.types import Vector

TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
POINT: Final = "trajectory_msgs/msg/JointTrajectoryPoint"
ARRAY: Final = "std_msgs/msg/Float64MultiArray"
_NAME: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True, slots=True)
class Ros:
    """Publish each action on ``topic`` as a message of ``type``.

    ``joints`` are the joints' names with colons between them; joint_1, joint_2, ... unless told. ``middleware``,
    ``domain_id`` and ``router`` are those of the ROS transport: default_middleware, ROS_DOMAIN_ID, rmw_zenoh's. For
    ``wait_s`` a subscription is waited for, without which there is no robot; 0: whoever listens, listens.
    """

    name: ClassVar[str] = "ros"

    topic: str = "/joint_trajectory"
    type: Literal["JointTrajectory", "Float64MultiArray"] = "JointTrajectory"
    joints: str = ""
    middleware: str = ""
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None
    router: str = ROUTER
    wait_s: Annotated[float, Field(ge=0, le=3600)] = 5.0

    def __post_init__(self) -> None:
        """Refuse what names no topic, joints or middleware."""
        if not _NAME.fullmatch(self.topic):
            raise UsageError(f"topic = '{self.topic}' should look like /name or /name/name")
        if self.joints and self.type != "JointTrajectory":
            raise UsageError(f"joints = '{self.joints}': {self.type} has no names of joints")
        if self.joints and len(set(self.names)) < len(self.names):
            raise UsageError(f"joints = '{self.joints}' names one twice")
        if self.middleware and self.middleware not in MIDDLEWARES:
            raise UsageError(f"middleware = '{self.middleware}' is none of {', '.join(MIDDLEWARES)}")
        endpoint_of(self.router)

    @property
    def names(self) -> list[str]:
        """Return the joints' names as given."""
        return self.joints.split(":") if self.joints else []

    def open(self, dims: int, period_ns: int) -> RosRobot:
        """Join the domain; raises UsageError for other joints than ``dims``, RobotError where nobody subscribes."""
        names = self.names or [f"joint_{joint}" for joint in range(1, dims + 1)]
        if len(names) != dims:
            raise UsageError(f"`robot`: ros: joints = '{self.joints}' names {len(names)} joints of {dims}")
        middleware = open_middleware(
            self.middleware,
            domain_id=domain_id(os.environ) if self.domain_id is None else self.domain_id,
            node_name="/s2a_bench/robot",
            router=Router(self.router),
        )
        try:
            return RosRobot(self, middleware, names, period_ns)
        except BaseException:
            middleware.close()
            raise


class RosRobot:
    """Publishes actions."""

    def __init__(self, asked: Ros, middleware: Middleware, joints: list[str], period_ns: int) -> None:
        """Announce the topic and take over ``middleware``; raises RobotError where nobody subscribes in time."""
        self._asked, self._middleware = asked, middleware
        type_name = TRAJECTORY if asked.type == "JointTrajectory" else ARRAY
        self._publisher = middleware.publisher(asked.topic, type_name, QoS(depth=1))
        self._joints = joints
        seconds, nanoseconds = divmod(period_ns, 1_000_000_000)
        self._period = ros.default("builtin_interfaces/msg/Duration", sec=seconds, nanosec=nanoseconds)
        if asked.wait_s and not appeared(lambda: self._publisher.matched() > 0, asked.wait_s):
            raise RobotError(
                f"`robot`: ros: nobody subscribed to {asked.topic} ({type_name}) in {asked.wait_s:g} s; start the "
                "controller first, with the same ROS_DOMAIN_ID, or publish to nobody with wait_s=0"
            )

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Publish an action; raises TransportError."""
        del at_ns
        if action is not None:
            self._publisher.send(self._publisher.pack(self._message(action)))

    def _message(self, action: Vector) -> Any:
        values = action.astype("float64")
        if self._asked.type == "Float64MultiArray":
            return ros.default(ARRAY, data=values)
        point = ros.default(POINT, positions=values, time_from_start=self._period)
        return ros.default(TRAJECTORY, joint_names=self._joints, points=[point])

    def state(self) -> tuple[float, ...]:
        """Return nothing: topics of actions say nothing of the robot."""
        return ()

    def describe(self) -> dict[str, str]:
        """Return the topic, and what carries its messages."""
        told = {**asdict(self._asked), "joints": ":".join(self._joints)}
        carried = self._middleware.describe()
        return {"robot": self._asked.name} | {name: str(value) for name, value in (told | carried).items()}

    def close(self) -> None:
        """Leave the domain."""
        self._middleware.close()
