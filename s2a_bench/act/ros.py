"""A robot behind ROS 2: every action is a message on a topic, every skill a goal of an action.

A message of trajectory_msgs/JointTrajectory has one point, to be reached one control period after its arrival: the zero
stamp in its header means "now" by convention. In a stall nothing is published, and a controller holds its last point.

A skill is a goal of ``<namespace>/execute_skill``, s2a_msgs/action/ExecuteSkill. ROS 2 has no message to change the
duration of a sent goal, so an extended skill is waited for, and compressing has no effect; abort cancels the goal. The
gap behaviour is published on ``<namespace>/gap`` as std_msgs/msg/String: stop, coast, hold, cruise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from threading import Lock, Thread
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from s2a_bench.act import ActionKind, ActionRobot, Report, Running, SkillKind
from s2a_bench.clock import now_ns
from s2a_bench.errors import RobotError, S2AError, TransportError, UsageError
from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.ros import ActionClient, ActionEvent, Middleware, QoS, Rejected, Result
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.join import RosParameters
from s2a_bench.ros.remap import ABSOLUTE
from s2a_bench.ros.service import appeared
from s2a_bench.types import Vector

TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
POINT: Final = "trajectory_msgs/msg/JointTrajectoryPoint"
ARRAY: Final = "std_msgs/msg/Float64MultiArray"
EXECUTE_SKILL: Final = "s2a_msgs/action/ExecuteSkill"
STRING: Final = "std_msgs/msg/String"
POLL_S: Final = 0.2
FOR_ACTIONS: Final = ("topic", "type", "joints")
FOR_SKILLS: Final = ("namespace",)


@dataclass(frozen=True, slots=True)
class RosRobot(RosParameters, SkillKind, ActionKind):
    """Publish each action on ``topic`` as a message of ``type``; send skills to the node in ``namespace``.

    ``joints`` are the joints' names separated by colons; joint_1, joint_2, ... by default. Without a peer, a
    subscription or an action server, within ``wait_s`` opening fails; 0 does not wait for a peer.
    """

    topic: str = "/joint_trajectory"
    type: Literal["JointTrajectory", "Float64MultiArray"] = "JointTrajectory"
    joints: str = ""
    namespace: str = "/robot"
    wait_s: Annotated[float, Field(ge=0, le=3600)] = 10.0

    def __post_init__(self) -> None:
        for field in ("topic", "namespace"):
            if not ABSOLUTE.fullmatch(value := getattr(self, field)):
                raise UsageError(f"{field} = '{value}' should look like /name or /name/name")
        if self.joints and self.type != "JointTrajectory":
            raise UsageError(f"joints = '{self.joints}': {self.type} has no names of joints")
        if self.joints and len(set(self.names)) < len(self.names):
            raise UsageError(f"joints = '{self.joints}' names one twice")
        RosParameters.__post_init__(self)

    @property
    def names(self) -> list[str]:
        return self.joints.split(":") if self.joints else []

    def open_skills(self, skills: SkillSet) -> RosSkills:  # noqa: ARG002 - any skill
        self._refuse(FOR_ACTIONS, "actions, not skills")
        return self.join("/s2a_bench/executor", lambda node: RosSkills(node, self.namespace, self.wait_s))

    def open_actions(self, dims: int, period_ns: int) -> RosActions:
        """Join the domain; raises UsageError for other joints than ``dims``, RobotError without a subscription."""
        self._refuse(FOR_SKILLS, "skills, not actions")
        names = self.names or [f"joint_{joint}" for joint in range(1, dims + 1)]
        if len(names) != dims:
            raise UsageError(f"`robot`: ros: joints = '{self.joints}' names {len(names)} joints of {dims}")
        return self.join("/s2a_bench/robot", lambda node: RosActions(self, node, names, period_ns))

    def _refuse(self, names: Sequence[str], about: str) -> None:
        for field in fields(self):
            if field.name in names and getattr(self, field.name) != field.default:
                raise UsageError(f"`robot`: ros: {field.name} is about {about}")


class RosActions(ActionRobot):
    def __init__(self, kind: RosRobot, middleware: Middleware, joints: list[str], period_ns: int) -> None:
        self._kind, self._middleware = kind, middleware
        type_name = TRAJECTORY if kind.type == "JointTrajectory" else ARRAY
        self._publisher = middleware.publisher(kind.topic, type_name, QoS(depth=1))
        self._joints = joints
        seconds, nanoseconds = divmod(period_ns, 1_000_000_000)
        self._period = ros.default("builtin_interfaces/msg/Duration", sec=seconds, nanosec=nanoseconds)
        self._publisher.pack(self._message(np.zeros(len(joints), "float32")))  # the first packing takes milliseconds
        if kind.wait_s and not appeared(lambda: self._publisher.matched() > 0, kind.wait_s):
            raise RobotError(
                f"`robot`: ros: no subscription to {kind.topic} ({type_name}) appeared in {kind.wait_s:g} s; start the "
                "controller first, with the same ROS_DOMAIN_ID, or publish without a subscription with wait_s=0"
            )

    def send(self, action: Vector | None, at_ns: int) -> None:  # noqa: ARG002 - at once
        if action is not None:
            self._publisher.send(self._publisher.pack(self._message(action)))

    def _message(self, action: Vector) -> Any:
        values = action.astype("float64")
        if self._kind.type == "Float64MultiArray":
            return ros.default(ARRAY, data=values)
        point = ros.default(POINT, positions=values, time_from_start=self._period)
        return ros.default(TRAJECTORY, joint_names=self._joints, points=[point])

    def describe(self) -> dict[str, str]:
        facts = {name: value for name, value in asdict(self._kind).items() if name not in FOR_SKILLS}
        facts |= {"robot": "ros", "joints": ":".join(self._joints), **self._middleware.describe()}
        return {name: str(value) for name, value in facts.items()}

    def close(self) -> None:
        self._middleware.close()


class RosSkills:
    """Sends skills as goals; its own thread receives the results."""

    def __init__(self, middleware: Middleware, namespace: str, wait_s: float) -> None:
        name = f"{namespace}/execute_skill"
        self._middleware = middleware
        self._client: ActionClient = middleware.action_client(name, EXECUTE_SKILL)
        self._gaps = middleware.publisher(f"{namespace}/gap", STRING, QoS(depth=1))
        if wait_s and not self._client.wait_for_server(wait_s):
            raise TransportError(
                f"`robot`: ros: no server of the action {name} ({EXECUTE_SKILL}) appeared in {wait_s:g} s; "
                "start the robot's node first, with the same ROS_DOMAIN_ID"
            )
        self._reports: dict[bytes, Report] = {}
        self._lock = Lock()
        self._closed = False
        self._thread = Thread(target=self._listen, name="skills", daemon=True)
        self._thread.start()

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        times = call.skill.durations
        goal = ros.default(
            EXECUTE_SKILL + "_Goal",
            skill=call.skill.name,
            arguments=[str(value) for value in call.values],
            duration=max(end_ns - now_ns(), 0) / 1e9,
            duration_least=times.least_s,
            duration_most=times.most_s,
        )
        packed = self._client.pack(goal)
        with self._lock:  # the result may be there before its report is
            goal_id = self._client.send(packed)
            self._reports[goal_id] = report
        return _Goal(self._client, goal_id)

    def hold(self, gap: Gap) -> None:
        self._gaps.send(self._gaps.pack(ros.default(STRING, data=gap)))

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._client.interrupt()
            self._thread.join()
            self._middleware.close()

    def _listen(self) -> None:
        while not self._closed:
            event = self._client.next_event(POLL_S)
            if isinstance(event, (Rejected, Result)):
                with self._lock:
                    report = self._reports.pop(event.goal_id, None)
                if report is not None:
                    report(self._error(event))

    def _error(self, event: ActionEvent) -> str:
        if not isinstance(event, Result):
            return "the robot rejected the goal"
        succeeded = event.status == Status.SUCCEEDED
        try:
            result = self._client.unpack_result(event.packed)
        except S2AError as error:
            return str(error) if succeeded else f"the goal ended {Status(event.status).name}"
        if not succeeded:
            return f"the goal ended {Status(event.status).name}" + (f": {result.message}" if result.message else "")
        return "" if result.success else result.message or "the robot reports no success"


class _Goal:
    def __init__(self, client: ActionClient, goal_id: bytes) -> None:
        self.abort = partial(client.cancel, goal_id)

    def retime(self, end_ns: int) -> None:
        """Do nothing: a sent goal keeps its duration."""

    def ended(self) -> bool:
        """Return False: the result reports the end."""
        return False
